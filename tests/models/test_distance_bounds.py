"""Bounds are bounds: never above Coal's exact distance, for every kind of body, at rest and along motions."""

import coal  # pyright: ignore[reportMissingImports]  # comes with Pinocchio, reached through a path file
import numpy as np
import pinocchio as pin
import pytest
import trimesh

from dyngrasp.models.distance_bounds import (
    Capsules,
    bounding_capsule,
    box_heights,
    heights,
    near_boxes,
    near_capsules,
    seen_from,
    tighten,
    tracks,
)

GJK = 1e-6  # m, tolerance of Coal's iterations


def convex(points: np.ndarray) -> coal.Convex:
    hull = trimesh.convex.convex_hull(points)
    vertices, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for vertex in hull.vertices:
        vertices.append(np.asarray(vertex))
    for face in hull.faces:
        faces.append(coal.Triangle(*(int(i) for i in face)))
    return coal.Convex(vertices, faces)


CLOUD = np.random.default_rng(5).normal(size=(30, 3)) * [0.02, 0.05, 0.01]
SHAPES = {
    "capsule": coal.Capsule(0.03, 0.2),
    "cylinder": coal.Cylinder(0.05, 0.06),
    "sphere": coal.Sphere(0.04),
    "box": coal.Box(0.02, 0.14, 0.06),
    "ellipsoid": coal.Ellipsoid(0.02, 0.007, 0.011),
    "convex": convex(CLOUD),
}


def distance(a, T_a: pin.SE3, b, T_b: pin.SE3) -> float:
    at = [coal.Transform3s(T.rotation, T.translation) for T in (T_a, T_b)]
    return coal.distance(a, at[0], b, at[1], coal.DistanceRequest(), coal.DistanceResult())


def walk(random: np.random.Generator, samples: int, spread: float) -> list[pin.SE3]:
    """A smooth random motion."""
    T = pin.SE3(pin.exp3(random.normal(size=3)), random.normal(size=3) * spread)
    step = pin.Motion(random.normal(size=6) * 0.02)
    motion = [T]
    for _ in range(samples - 1):
        motion.append(motion[-1] * pin.exp6(step))
    return motion


def arrays(motion: list[pin.SE3]) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (3, 3, S) and positions (3, S)."""
    return np.stack([T.rotation for T in motion], axis=-1), np.stack([T.translation for T in motion], axis=-1)


@pytest.mark.parametrize("name", SHAPES)
def test_bounding_capsule_contains_the_body(name):
    ends, radius = bounding_capsule(SHAPES[name])
    for direction in np.random.default_rng(0).normal(size=(300, 3)):
        direction /= np.linalg.norm(direction)
        plane = coal.Halfspace(direction, 0.0)
        lowest = distance(SHAPES[name], pin.SE3.Identity(), plane, pin.SE3.Identity())
        bound = (ends @ direction).min() - radius
        assert bound <= lowest + 1e-12
        # A bound that is far off would contain it as well; the rounded ends cost one radius, a cloud a little more.
        assert lowest - bound < 1.5 * radius


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("seed", range(6))
def test_bounds_to_boxes_and_their_neighbours(name, seed):
    """Against the exact distance to the box itself at every sample, also of those that were skipped."""
    random = np.random.default_rng(seed)
    samples, horizon = 60, 0.15
    body, part = walk(random, samples, 0.12), walk(random, samples, 0.02)
    half = random.uniform(0.02, 0.08, (2, 3))
    centres = random.normal(size=(2, 3)) * 0.03
    ends, radius = bounding_capsule(SHAPES[name])
    capsules = Capsules(np.zeros(1, np.int64), ends[None], np.array([radius]))
    R, p = arrays(body)
    seen = tracks(*seen_from(*arrays(part), R[None], p[None]), capsules)
    start, stop = 3, samples - 4
    first, box, rows = near_boxes(
        seen.ends, seen.travel, capsules.radii, np.zeros(1, np.int64), np.array([start]), np.array([stop]),
        centres - half, centres + half, horizon,
    )  # fmt: skip
    assert (first == 0).all()
    exact = np.array(
        [
            [
                distance(SHAPES[name], body[k], coal.Box(*(2 * half[i])), part[k] * pin.SE3(np.eye(3), centres[i]))
                for k in range(samples)
            ]
            for i in range(2)
        ]
    )
    for i in range(2):
        row = rows[list(box).index(i)] if i in box else np.full(samples, np.inf)
        counted = np.arange(start, stop)
        known = np.isfinite(row) | np.isneginf(row)
        assert not known[:start].any()
        assert not known[stop:].any()
        assert (row[counted][known[counted]] <= exact[i, counted][known[counted]] + GJK).all()
        skipped = counted[~known[counted]]
        assert (exact[i, skipped] >= horizon - GJK).all()
        # One measurement bounds all neighbours.
        for k in (start, (start + stop) // 2):
            bounds = np.full(samples, -np.inf)
            least, where = tighten(bounds, seen.travel[0], k, exact[i, k])
            others = np.delete(np.arange(samples), k)
            assert np.isposinf(bounds[k])
            assert (bounds[others] <= exact[i, others] + 2 * GJK).all()
            assert (least, where) == (bounds.min(), bounds.argmin())


@pytest.mark.parametrize("seed", range(8))
def test_bounds_between_capsules_are_exact_where_they_are_apart(seed):
    random = np.random.default_rng(seed)
    samples, horizon = 50, 0.2
    motions = [walk(random, samples, 0.15) for _ in range(3)]
    shapes = [SHAPES["capsule"], SHAPES["sphere"], SHAPES["cylinder"]]
    bounding = [bounding_capsule(shape) for shape in shapes]
    capsules = Capsules(
        np.arange(3), np.array([ends for ends, _ in bounding]), np.array([radius for _, radius in bounding])
    )
    R, p = (np.stack(column) for column in zip(*(arrays(motion) for motion in motions), strict=True))
    world = tracks(R, p, capsules)
    first, second = np.array([0, 0, 1]), np.array([1, 2, 2])
    kept, rows = near_capsules(world.ends, world.travel, capsules.radii, first, second, horizon)
    for n, (i, j) in enumerate(zip(first, second, strict=True)):
        row = rows[list(kept).index(n)] if n in kept else np.full(samples, np.inf)
        for k in range(samples):
            exact = distance(shapes[i], motions[i][k], shapes[j], motions[j][k])
            if np.isinf(row[k]):
                assert exact >= horizon - GJK
            else:
                assert row[k] <= exact + GJK
                if j == 1 and exact > 0:
                    assert row[k] == pytest.approx(exact, abs=GJK)


def test_parallel_and_crossing_segments():
    """The cases in which the nearest points of two lines are not unique, or not on the segments."""
    segments = np.array(
        [
            [[0, 0, 0], [1, 0, 0]],
            [[0.5, 0.3, 0], [2, 0.3, 0]],  # parallel, overlapping
            [[3, 0.4, 0], [4, 0.4, 0]],  # parallel, behind
            [[0.5, -1, 0.2], [0.5, 1, 0.2]],  # crossing above
            [[2, 2, 0], [2, 2, 0]],  # a point
        ],
        dtype=float,
    )
    capsules = Capsules(np.zeros(5, np.int64), segments, np.zeros(5))
    world = tracks(np.eye(3)[None, :, :, None], np.zeros((1, 3, 1)), capsules)
    others = np.arange(1, 5)
    kept, rows = near_capsules(world.ends, world.travel, np.zeros(5), np.zeros(4, np.int64), others, 10.0)
    np.testing.assert_array_equal(kept, range(4))
    np.testing.assert_allclose(rows[:, 0], [0.3, np.hypot(2, 0.4), 0.2, np.hypot(1, 2)], atol=1e-15)
    backwards = near_capsules(world.ends, world.travel, np.zeros(5), others, np.zeros(4, np.int64), 10.0)[1]
    np.testing.assert_allclose(backwards, rows, atol=1e-15)


def test_heights_are_those_of_the_lowest_points():
    random = np.random.default_rng(1)
    motion = walk(random, 30, 0.3)
    R, p = arrays(motion)
    ends, radius = bounding_capsule(SHAPES["capsule"])
    capsules = Capsules(np.zeros(1, np.int64), ends[None], np.array([radius]))
    world = tracks(R[None], p[None], capsules)
    ground = coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)
    expected = [distance(SHAPES["capsule"], T, ground, pin.SE3.Identity()) for T in motion]
    np.testing.assert_allclose(heights(world.ends, capsules.radii, np.zeros(1, np.int64))[0], expected, atol=1e-12)
    half = np.array([0.01, 0.07, 0.03])
    rows = box_heights(R[2], p[2], -half[None], half[None], 4)
    expected = [distance(SHAPES["box"], T, ground, pin.SE3.Identity()) for T in motion]
    assert np.isposinf(rows[0, :4]).all()
    np.testing.assert_allclose(rows[0, 4:], expected[4:], atol=1e-12)
