"""The differential filter s / (1 + T₁ s) against its analytic responses."""

import numpy as np
import pytest

from dyngrasp.control.velocity_filter import PAPER_TIME_CONSTANT, VelocityFilter


def run(positions, dt):
    velocity_filter = VelocityFilter(PAPER_TIME_CONSTANT, dt)
    return np.array([velocity_filter.update([p])[0] for p in positions])


@pytest.mark.parametrize("dt", [1e-3, 125e-6])
def test_ramp_response_is_exact_at_any_rate(dt):
    t = np.arange(0, 0.1, dt)
    # The discretisation is exact for positions that are linear between samples; only rounding is left.
    np.testing.assert_allclose(run(0.7 * t, dt), 0.7 * (1 - np.exp(-t / PAPER_TIME_CONSTANT)), atol=1e-10)


@pytest.mark.parametrize("dt", [1e-3, 125e-6])
@pytest.mark.parametrize("frequency", [1.0, 13.0])
def test_sine_response_has_the_gain_and_lag_of_the_transfer_function(dt, frequency):
    t = np.arange(0, 1.5, dt)
    omega = 2 * np.pi * frequency
    response = 1j * omega / (1 + 1j * omega * PAPER_TIME_CONSTANT)
    expected = np.imag(response * np.exp(1j * omega * t))
    late = t > 0.5  # 40 time constants: the transient is gone
    # Chords instead of the sine: a lag of half a sample, and (ω dt)²/24 of the gain.
    tolerance = abs(response) * (0.6 * omega * dt)
    np.testing.assert_allclose(run(np.sin(omega * t), dt)[late], expected[late], atol=tolerance)


def test_starts_at_rest_and_keeps_its_own_copy():
    velocity_filter = VelocityFilter(PAPER_TIME_CONSTANT, 1e-3)
    first = velocity_filter.update(np.array([3.0, -2.0]))
    np.testing.assert_array_equal(first, 0.0)
    first += 5.0
    np.testing.assert_array_equal(velocity_filter.update(np.array([3.0, -2.0])), 0.0)


@pytest.mark.parametrize(("time_constant", "dt"), [(0.0, 1e-3), (0.012, 0.0), (-1.0, 1e-3), (float("nan"), 1e-3)])
def test_refuses_times_that_are_not_positive(time_constant, dt):
    with pytest.raises(ValueError, match="must be > 0"):
        VelocityFilter(time_constant, dt)
