"""Compiled node functions, their fallback, and the cache that keeps them."""

import logging
import os
import stat
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.models.pinch import Pinch
from dyngrasp.planning import constraints
from dyngrasp.planning.collocation import code_cache, node_functions
from dyngrasp.planning.collocation.code_cache import COMPILER_VARIABLE, CompilationError
from dyngrasp.planning.collocation.node_functions import CompiledNodeFunctions, InterpretedNodeFunctions
from dyngrasp.planning.collocation.work_arrays import padded

SOURCE = "double answer(double x) { return 2 * x + %d; }\n"
K = 5


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache, and no library in memory."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(code_cache, "_libraries", {})
    return tmp_path / "dyngrasp" / "code"


@pytest.fixture
def needs_compiler():
    if code_cache.compiler() is None:
        pytest.skip("no C compiler")


@pytest.fixture(scope="module")
def torque(iiwa):
    return constraints.torque_rows(iiwa, K - 1)


@pytest.fixture(scope="module")
def hold(iiwa):
    part = pin.Inertia(1.5, np.array([0.01, -0.02, 0.2]), np.diag([0.004, 0.006, 0.005]))
    T_flange_grasp = pin.SE3(pin.utils.rotate("x", 0.3), np.array([0.0, 0.02, 0.17]))
    velocity = np.random.default_rng(8).normal(size=(K, 7))
    return constraints.hold(iiwa, part, T_flange_grasp, Pinch(30.0, 0.5, 0.01, 0.03), velocity)


def evaluate(functions, constraint, seed=0, column=2, total=11):
    """Values and derivatives in the middle of wider arrays, as beside other constraints."""
    random = np.random.default_rng(seed)
    q, v = random.normal(size=(2, K, 7))
    weights = random.normal(size=(total, padded(K)))
    values, g = np.full((K, total), 7.0), np.full((K, total), 7.0)
    jacobian, hessian = np.full((total, 14, padded(K)), 7.0), np.ones((14, 14, padded(K)))
    functions.values(q, v, constraint.parameters, values, column)
    functions.derivatives(q, v, constraint.parameters, weights, g, jacobian, hessian, column)
    return values, g, jacobian[:, :, :K], hessian[:, :, :K]


def test_compiled_and_interpreted_agree(needs_compiler, torque):
    compiled = evaluate(CompiledNodeFunctions(torque.function, "torque"), torque)
    interpreted = evaluate(InterpretedNodeFunctions(torque.function), torque)
    for fast, slow in zip(compiled, interpreted, strict=True):
        # The same expressions; the compiler may fuse multiplications and additions.
        np.testing.assert_allclose(fast, slow, rtol=1e-11, atol=1e-11 * np.abs(slow).max())
    values, g, jacobian, hessian = compiled
    np.testing.assert_allclose(values, g, rtol=1e-12, atol=1e-12)
    assert (values[:, :2] == 7.0).all()
    assert (values[:, 9:] == 7.0).all()
    assert (jacobian[:2] == 7.0).all()
    assert (jacobian[9:] == 7.0).all()
    np.testing.assert_allclose(hessian, hessian.transpose(1, 0, 2), atol=1e-12 * np.abs(hessian).max())


@pytest.mark.parametrize("kind", [CompiledNodeFunctions, InterpretedNodeFunctions])
@pytest.mark.parametrize("name", ["torque", "hold"])
def test_derivatives_are_those_of_the_values(needs_compiler, name, kind, request):
    """The Hessian of the torque rows is shorter as a whole, that of the hold rows as a triangle."""
    constraint = request.getfixturevalue(name)
    functions = kind(constraint.function, name) if kind is CompiledNodeFunctions else kind(constraint.function)
    random, rows = np.random.default_rng(3), functions.rows
    u, weights = random.normal(size=(K, 14)), random.normal(size=(rows, padded(K)))
    p, step = constraint.parameters, 1e-6

    def at(u):
        g, jacobian, hessian = np.empty((K, rows)), np.empty((rows, 14, padded(K))), np.zeros((14, 14, padded(K)))
        q, v = np.ascontiguousarray(u[:, :7]), np.ascontiguousarray(u[:, 7:])
        functions.derivatives(q, v, p, weights, g, jacobian, hessian, 0)
        return g, jacobian[:, :, :K], hessian[:, :, :K]

    _, jacobian, hessian = at(u)
    for j in range(14):
        up, down = u.copy(), u.copy()
        up[:, j] += step
        down[:, j] -= step
        (g_up, J_up, _), (g_down, J_down, _) = at(up), at(down)
        np.testing.assert_allclose(jacobian[:, j].T, (g_up - g_down) / (2 * step), atol=1e-6)
        by_j = np.einsum("mk,mik->ik", weights[:, :K], (J_up - J_down) / (2 * step))
        np.testing.assert_allclose(hessian[j], by_j, atol=1e-5)


def test_which_rows_depend_on_the_acceleration():
    q, v, p = (ca.SX.sym(name, 2) for name in "qvp")
    function = ca.Function("rows", [q, v, p], [ca.vertcat(q[0], v[1] * q[0], p[0], v[0])])
    found = InterpretedNodeFunctions(function).depends_on_acceleration
    np.testing.assert_array_equal(found, [False, True, False, True])


def test_without_a_compiler_the_virtual_machine_serves(monkeypatch, torque, caplog):
    monkeypatch.setattr(node_functions, "_made", {})
    monkeypatch.setenv(COMPILER_VARIABLE, "")
    with caplog.at_level(logging.WARNING):
        functions = node_functions.node_functions(torque)
    assert isinstance(functions, InterpretedNodeFunctions)
    assert "virtual machine" in caplog.text
    monkeypatch.setenv(COMPILER_VARIABLE, "no-such-compiler-anywhere")
    assert isinstance(node_functions.node_functions(torque), InterpretedNodeFunctions)


def test_a_compiler_that_fails_is_not_fatal(monkeypatch, cache, torque):
    monkeypatch.setattr(node_functions, "_made", {})
    monkeypatch.setenv(COMPILER_VARIABLE, "false")
    assert isinstance(node_functions.node_functions(torque), InterpretedNodeFunctions)


def test_built_once_and_announced(needs_compiler, cache, caplog, monkeypatch):
    with caplog.at_level(logging.WARNING):
        library = code_cache.load(SOURCE % 1, "a test")
    assert "compiling a test" in caplog.text
    library.answer.restype, library.answer.argtypes = ctypes_double()
    assert library.answer(3.0) == 7.0
    (entry,) = cache.glob("*.so")
    assert stat.S_IMODE(cache.stat().st_mode) == 0o700
    caplog.clear()
    monkeypatch.setattr(code_cache, "_libraries", {})
    code_cache.load(SOURCE % 1, "a test")
    assert caplog.text == ""
    assert [entry] == list(cache.glob("*.so"))
    code_cache.load(SOURCE % 2, "another test")
    assert len(list(cache.glob("*.so"))) == 2
    assert [path for path in cache.iterdir() if path.suffix != ".so"] == []


def test_a_damaged_entry_is_built_again(needs_compiler, cache, monkeypatch):
    code_cache.load(SOURCE % 3, "a test")
    (entry,) = cache.glob("*.so")
    content = entry.read_bytes()
    for damage in (b"", content[: len(content) // 2], content[:-1] + b"\x01"):
        # A new file: to write into one that is loaded would damage this very process.
        entry.unlink()
        entry.write_bytes(damage)
        monkeypatch.setattr(code_cache, "_libraries", {})
        library = code_cache.load(SOURCE % 3, "a test")
        library.answer.restype, library.answer.argtypes = ctypes_double()
        assert library.answer(1.0) == 5.0
        assert [path.read_bytes() for path in cache.glob("*.so")] == [content]


def test_a_cache_that_others_may_write_to_is_not_used(needs_compiler, cache):
    cache.mkdir(parents=True)
    cache.chmod(0o777)
    library = code_cache.load(SOURCE % 4, "a test")
    library.answer.restype, library.answer.argtypes = ctypes_double()
    assert library.answer(1.0) == 6.0
    assert list(cache.iterdir()) == []


def test_two_processes_at_once(needs_compiler, cache):
    script = (
        "from dyngrasp.planning.collocation import code_cache; import ctypes\n"
        f"f = code_cache.load({SOURCE % 5!r}, 'a test').answer\n"
        "f.restype, f.argtypes = ctypes.c_double, [ctypes.c_double]\n"
        "assert f(1.0) == 7.0\n"
    )
    environment = os.environ | {"XDG_CACHE_HOME": str(cache.parent.parent)}
    running = [subprocess.Popen([sys.executable, "-c", script], env=environment) for _ in range(3)]
    assert [process.wait(timeout=120) for process in running] == [0, 0, 0]
    assert len(list(cache.glob("*.so"))) == 1


def test_refusals_name_the_reason(monkeypatch, cache):
    monkeypatch.setenv(COMPILER_VARIABLE, "")
    with pytest.raises(CompilationError, match="no C compiler"):
        code_cache.load(SOURCE % 6, "a test")


def test_what_the_compiler_says_is_passed_on(needs_compiler, cache):
    with pytest.raises(CompilationError, match="error"):
        code_cache.load("this is no C", "a test")
    assert list(cache.iterdir()) == []


def test_importing_compiles_nothing(tmp_path):
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
    script = "import dyngrasp, dyngrasp.planning.collocation.structured"
    subprocess.run([sys.executable, "-c", script], env=environment, check=True, timeout=60)
    assert not (Path(tmp_path) / "dyngrasp").exists()


def ctypes_double():
    import ctypes

    return ctypes.c_double, [ctypes.c_double]
