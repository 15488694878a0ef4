"""Consistency, outliers, jumps, late and worthless measurements, over simulated motions that the filter cannot see."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.stats import chi2

from dyngrasp.errors import InvalidProblem
from dyngrasp.perception.pose_filter import PoseFilter, PoseFilterSettings, PoseUnknown, Verdict
from dyngrasp.signals import PoseEstimate

FRAME = 1 / 30
SIGMA = np.repeat([6e-4, np.deg2rad(0.3)], 3)
R = np.diag(SIGMA**2)
STILL, MOVING = PoseFilterSettings.still(), PoseFilterSettings()
FINE = 10


def true_motion(random, settings, frames):
    """Poses at the frames, and twists, of a body that moves as the settings say: ten fine steps a frame."""
    motion = settings.motion
    pose = pin.SE3(pin.exp3(random.normal(size=3)), random.uniform(-1, 1, 3))
    twist = random.normal(size=6) * np.repeat(motion.first_velocity, 3)
    poses, twists = [pose], [twist]
    h = FRAME / FINE
    for k in range((frames - 1) * FINE):
        before = twist
        twist = twist + random.normal(size=6) * np.repeat(motion.acceleration, 3) * np.sqrt(h)
        mid = 0.5 * (before + twist)
        pose = pin.SE3(pin.exp3(mid[3:] * h) @ pose.rotation, pose.translation + mid[:3] * h)
        pose = pose * pin.exp6(random.normal(size=6) * np.repeat(motion.drift, 3) * np.sqrt(h))
        if (k + 1) % FINE == 0:
            poses.append(pose)
            twists.append(twist)
    return poses, twists


def measure(random, pose, t, latency=0.0):
    return PoseEstimate(pose * pin.exp6(random.normal(size=6) * SIGMA).inverse(), R, t, t + latency)


def error(estimate, pose):
    return pin.log6(estimate.T_world_object.actInv(pose)).vector


@pytest.mark.parametrize("settings", [STILL, MOVING], ids=["still", "moving"])
def test_errors_are_as_large_as_the_filter_says(settings):
    runs, frames = 100, 40
    nees = np.zeros((runs, frames))
    nees_all = np.zeros(runs)
    for run in range(runs):
        random = np.random.default_rng(run)
        poses, twists = true_motion(random, settings, frames)
        pose_filter = PoseFilter(settings, prior=measure(random, poses[0], 0.0))
        for k in range(1, frames):
            t = k * FRAME
            pose_filter.update(measure(random, poses[k], t))
            estimate = pose_filter.estimate(t)
            e = error(estimate, poses[k])
            nees[run, k] = e @ np.linalg.solve(estimate.covariance, e)
        state = pose_filter.state(t)
        e = np.concatenate([e, twists[-1] - state.twist_world])
        if settings is MOVING:
            nees_all[run] = e @ np.linalg.solve(state.covariance, e)
    low, high = chi2.ppf([0.025, 0.975], 6 * runs) / runs
    mean = nees[:, 1:].mean(axis=0)
    assert low < mean[-1] < high
    # 95 % of the frames are expected within the 95 % bounds; they are correlated, so few independent ones stand behind.
    assert np.mean((low < mean) & (mean < high)) > 0.8
    if settings is MOVING:
        low, high = chi2.ppf([0.025, 0.975], 12 * runs) / runs
        assert low < nees_all.mean() < high


def test_a_wrong_noise_is_noticed_by_that_measure():
    # The check above can fail: measurements twice as noisy as they claim leave the bounds at once.
    high = chi2.ppf(0.975, 6 * 50) / 50
    nees = []
    for run in range(50):
        random = np.random.default_rng(run)
        pose_filter = PoseFilter(replace(STILL, gate=1 - 1e-9), prior=measure(random, pin.SE3.Identity(), 0.0))
        for k in range(1, 20):
            noisy = pin.exp6(2 * random.normal(size=6) * SIGMA)
            pose_filter.update(PoseEstimate(noisy, R, k * FRAME, k * FRAME))
        estimate = pose_filter.estimate(k * FRAME)
        e = error(estimate, pin.SE3.Identity())
        nees.append(e @ np.linalg.solve(estimate.covariance, e))
    assert np.mean(nees) > 2 * high


def spoil(random, pose, t):
    """An outlier: 2 cm to 1 m aside, turned by 180°, or no numbers."""
    kind = random.integers(3)
    if kind == 0:
        aside = random.normal(size=3)
        shift = pin.SE3(np.eye(3), aside / np.linalg.norm(aside) * 10 ** random.uniform(np.log10(0.02), 0))
        return measure(random, shift * pose, t)
    if kind == 1:
        axis = random.normal(size=3)
        return measure(random, pose * pin.SE3(pin.exp3(np.pi * axis / np.linalg.norm(axis)), np.zeros(3)), t)
    return PoseEstimate(pin.SE3(np.eye(3), np.full(3, np.nan)), R, t, t)


@pytest.mark.parametrize("settings", [STILL, MOVING], ids=["still", "moving"])
def test_outliers_are_refused_and_counted(settings):
    spoilt = accepted = beyond = good_refused = good = 0
    counted = dict.fromkeys(Verdict, 0)
    for run in range(40):
        random = np.random.default_rng(1000 + run)
        poses, _ = true_motion(random, settings, 60)
        pose_filter = PoseFilter(settings)
        for k, pose in enumerate(poses):
            t = k * FRAME
            # Before the velocity is known, 2 cm from frame to frame are what a moving part may do.
            bad = random.uniform() < 0.05 and (settings is STILL or k >= 10)
            measured = spoil(random, pose, t) if bad else measure(random, pose, t)
            before = pose_filter.estimate(t) if pose_filter.acquired else None
            verdict = pose_filter.update(measured)
            spoilt += bad
            if bad and verdict in (Verdict.ACCEPTED, Verdict.ACQUIRED):
                accepted += 1
            if before is not None and verdict is Verdict.ACCEPTED:
                # Written out again, independently of the filter's own gate.
                d = pin.log6(before.T_world_object.inverse() * measured.T_world_object).vector
                beyond += d @ np.linalg.inv(before.covariance + measured.covariance) @ d > 25.0
            if not bad and before is not None:
                good += 1
                good_refused += verdict is Verdict.GATED
        for verdict, count in pose_filter.counts.items():
            counted[verdict] += count
        # One in a million for a consistent estimate; and its sigma is small, also where the last frames were spoilt.
        estimate = pose_filter.estimate(t)
        e = error(estimate, poses[-1])
        assert e @ np.linalg.solve(estimate.covariance, e) < chi2.ppf(1 - 1e-6, 6)
        assert np.sqrt(np.diag(estimate.covariance)[:3]).max() < 4e-3
    assert spoilt > 60
    assert accepted == 0
    assert beyond == 0
    assert counted[Verdict.NAN] > 10
    assert sum(counted.values()) == 40 * 60
    # The gate lets 99.9 % of good measurements pass.
    assert good_refused < 0.005 * good


@pytest.mark.parametrize("settings", [STILL, MOVING], ids=["still", "moving"])
@pytest.mark.parametrize("jump", [0.01, 0.05, 0.4])
def test_a_true_jump_is_followed_within_five_frames(settings, jump):
    for run in range(10):
        random = np.random.default_rng(run)
        poses, _ = true_motion(random, settings, 40)
        pose_filter = PoseFilter(settings)
        moved = pin.SE3(pin.exp3(np.array([0.0, 0.0, 5 * jump])), jump * np.array([0.6, -0.8, 0.0]))
        verdicts = []
        for k, pose in enumerate(poses):
            there = pin.SE3(moved.rotation @ pose.rotation, pose.translation + moved.translation) if k >= 25 else pose
            verdicts.append(pose_filter.update(measure(random, there, k * FRAME)))
            if k >= 29:
                e = error(pose_filter.estimate(k * FRAME), there)
                # Measurements of 0.6 mm and 0.3° an axis, and a velocity that has to be found again.
                assert np.linalg.norm(e[:3]) < 5e-3
                assert np.linalg.norm(e[3:]) < np.deg2rad(2)
        assert Verdict.ACQUIRED in verdicts[25:30] or (jump == 0.01 and settings is MOVING)


def test_late_measurements_act_at_their_capture_time():
    random = np.random.default_rng(2)
    poses, _ = true_motion(random, MOVING, 30)
    measured = [measure(random, pose, k * FRAME) for k, pose in enumerate(poses)]
    in_order, out_of_order = PoseFilter(MOVING, measured[0]), PoseFilter(MOVING, measured[0])
    order = np.arange(1, 30)
    order[10:14] = [14, 11, 13, 12]
    order[20:22] = [22, 21]
    for k in range(1, 30):
        in_order.update(measured[k])
    for k in order:
        assert out_of_order.update(replace(measured[k], t_receipt=30 * FRAME)) is Verdict.ACCEPTED
    a, b = in_order.state(30 * FRAME), out_of_order.state(30 * FRAME)
    np.testing.assert_allclose(a.T_world_object.homogeneous, b.T_world_object.homogeneous, atol=1e-12)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-9, atol=1e-18)
    # Taken at the time of their receipt instead they would be off by velocity times delay.
    wrong = PoseFilter(MOVING, measured[0])
    for k in range(1, 30):
        wrong.update(replace(measured[k], t_capture=(k + 2) * FRAME, t_receipt=(k + 2) * FRAME))
    lag = np.linalg.norm(error(wrong.estimate(31 * FRAME), a.T_world_object)[:3])
    assert lag > 5 * np.linalg.norm(error(in_order.estimate(29 * FRAME), poses[29])[:3])


def test_refusals_by_reason():
    settings = replace(MOVING, history=0.2)
    pose_filter = PoseFilter(settings)
    random = np.random.default_rng(0)
    T = pin.SE3.Identity()
    for k in range(10):
        pose_filter.update(measure(random, T, k * FRAME))
    newest = 9 * FRAME
    good = measure(random, T, newest)
    before = pose_filter.state(1.0)
    cases = [
        (replace(good), newest, Verdict.REPEATED),
        (replace(good, t_capture=0.01, t_receipt=newest), newest, Verdict.OLD),
        (replace(good, t_capture=newest + 1.0, t_receipt=newest + 1.0), newest, Verdict.FUTURE),
        (replace(good, t_capture=newest + 1.0, t_receipt=newest), newest, Verdict.CLOCK),
        (replace(good, t_capture=1.7e9, t_receipt=1.7e9), newest, Verdict.FUTURE),
        (replace(good, t_capture=newest + 0.01, t_receipt=newest + 0.01), newest - 1.0, Verdict.CLOCK),
        (replace(good, t_capture=np.nan), newest, Verdict.NAN),
        (replace(good, covariance=np.full((6, 6), np.inf)), newest, Verdict.NAN),
        (replace(good, covariance=-R), newest, Verdict.NAN),
        (replace(good, T_world_object=pin.SE3(2 * np.eye(3), np.zeros(3))), newest, Verdict.NAN),
        (replace(good, twist_world=np.full(6, np.nan)), newest, Verdict.NAN),
    ]
    expected = dict(pose_filter.counts)
    for measured, now, verdict in cases:
        assert pose_filter.update(measured, now) is verdict
        expected[verdict] += 1
    assert dict(pose_filter.counts) == expected
    np.testing.assert_array_equal(pose_filter.state(1.0).covariance, before.covariance)


def test_refused_frames_do_not_hinder_good_ones():
    pose_filter = PoseFilter(STILL)
    random = np.random.default_rng(0)
    for k in range(8):
        wild = PoseEstimate(pin.SE3.Identity(), R, 1e9, 1e9)
        assert pose_filter.update(wild, now=k * FRAME) is Verdict.FUTURE
        pose_filter.update(measure(random, pin.SE3.Identity(), k * FRAME), now=k * FRAME)
    assert pose_filter.counts[Verdict.ACCEPTED] + pose_filter.counts[Verdict.ACQUIRED] == 8 - 3


def test_the_track_decides_between_both_poses_of_a_square():
    random = np.random.default_rng(3)
    T = pin.SE3(pin.exp3(np.array([0.1, 0.0, 0.0])), np.zeros(3))
    mirrored = pin.SE3(pin.exp3(np.array([-0.1, 0.0, 0.0])), np.zeros(3))
    pose_filter = PoseFilter(STILL, prior=measure(random, T, 0.0))
    for k in range(1, 10):
        right, wrong = measure(random, T, k * FRAME), measure(random, mirrored, k * FRAME)
        order = (right, wrong) if k % 2 else (wrong, right)
        assert pose_filter.update(order) is Verdict.ACCEPTED
    assert np.linalg.norm(error(pose_filter.estimate(k * FRAME), T)[3:]) < np.deg2rad(0.5)


def test_a_consistent_row_begins_even_if_the_wrong_pose_came_first():
    # The camera moves: the mirrored pose of a part at rest wanders in the world, the right one stays.
    random = np.random.default_rng(4)
    T = pin.SE3.Identity()
    pose_filter = PoseFilter(STILL)
    for k in range(6):
        wandering = pin.SE3(pin.exp3(np.array([0.2 + 0.05 * k, 0.0, 0.0])), np.zeros(3))
        pose_filter.update((measure(random, wandering, k * FRAME), measure(random, T, k * FRAME)))
    assert pose_filter.acquired
    assert np.linalg.norm(error(pose_filter.estimate(k * FRAME), T)) < np.deg2rad(1)


def test_a_vague_pose_does_not_win_by_being_vague():
    # One marker's pose beside that of three: its distance in standard deviations is as small, its knowledge is not.
    random = np.random.default_rng(8)
    T = pin.SE3.Identity()
    wrong = pin.SE3(pin.exp3(np.array([0.4, 0.0, 0.0])), np.array([0.03, 0.0, 0.0]))
    pose_filter = PoseFilter(STILL)
    for k in range(4):
        t = k * FRAME
        pose_filter.update((PoseEstimate(wrong, 900 * R, t, t), measure(random, T, t)))
    assert np.linalg.norm(error(pose_filter.estimate(t), T)) < np.deg2rad(1)


def test_without_measurements_the_uncertainty_grows():
    random = np.random.default_rng(5)
    poses, _ = true_motion(random, MOVING, 20)
    pose_filter = PoseFilter(MOVING)
    for k, pose in enumerate(poses):
        pose_filter.update(measure(random, pose, k * FRAME))
    times = 19 * FRAME + np.array([0.0, 0.1, 0.3, 1.0, 3.0])
    sizes = [np.trace(pose_filter.estimate(t).covariance[:3, :3]) for t in times]
    assert (np.diff(sizes) > 0).all()
    # The white acceleration alone: q t³/3 an axis.
    assert sizes[-1] > 3 * MOVING.motion.acceleration[0] ** 2 * 3.0**3 / 3
    # After a long gap a single frame is not believed, a row of them is, wherever the part may be.
    late = [measure(random, pin.SE3.Identity(), 30.0 + k * FRAME) for k in range(4)]
    assert [pose_filter.update(m) for m in late] == [Verdict.GATED] * 3 + [Verdict.ACQUIRED]


def test_a_pose_that_is_not_known_is_not_given():
    pose_filter = PoseFilter(MOVING)
    with pytest.raises(PoseUnknown, match="4 frames"):
        pose_filter.estimate(0.0)
    random = np.random.default_rng(0)
    for k in range(40):
        pose_filter.update(measure(random, pin.SE3.Identity(), k * FRAME))
    with pytest.raises(PoseUnknown, match="history begins"):
        pose_filter.estimate(0.0)
    with pytest.raises(InvalidProblem, match="without a pose"):
        pose_filter.update(())
    other = measure(random, pin.SE3.Identity(), 2.0)
    with pytest.raises(InvalidProblem, match="one capture time"):
        pose_filter.update((other, replace(other, t_capture=2.1)))


@pytest.mark.parametrize(
    "change",
    [{"gate": 1.0}, {"acquire_frames": 0}, {"history": -1.0}, {"longest_gap": np.nan}, {"acquire_frames": -1}],
)
def test_impossible_settings_are_refused(change):
    with pytest.raises(InvalidProblem):
        PoseFilterSettings(**change)
