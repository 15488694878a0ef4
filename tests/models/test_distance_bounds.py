"""Bounds are bounds: never above Coal's exact distance, for every kind of body, at rest and along motions."""

import coal  # pyright: ignore[reportMissingImports]  # comes with Pinocchio, reached through a path file
import numpy as np
import pinocchio as pin
import pytest
import trimesh

from dyngrasp.models.bounding_volumes import Pieces, bounding_bodies, bounding_capsule, boxes_around
from dyngrasp.models.distance_bounds import (
    add_near_each_other,
    add_near_ground,
    add_near_pieces,
    add_pieces_near_ground,
    first_of,
    lowest,
    space_for,
    tighten,
)
from dyngrasp.models.link_motion import follow, seen_from

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


def on_links(shapes, links, motions):
    """Bodies at random places on moving links, their motion, and where they are at every sample."""
    random = np.random.default_rng(len(shapes))
    placements = [pin.SE3(pin.exp3(random.normal(size=3)), random.normal(size=3) * 0.05) for _ in shapes]
    bodies = bounding_bodies(shapes, placements, np.array(links), len(motions))
    R, p = (np.stack(column) for column in zip(*(arrays(motion) for motion in motions), strict=True))
    placed = [[T * place for T in motions[link]] for link, place in zip(links, placements, strict=True)]
    return bodies, R, p, placed


def added(add, *arguments):
    """What one of the functions adds to nothing, where each pair has room."""
    found = space_for(100, 10000)
    return first_of(found, add(*arguments, found, 0))


def still(samples):
    return [pin.SE3.Identity()] * samples


def check(found, exact, horizon, counted):
    """Bounds are below the exact distances {pair: (S,)}, and what is left out is farther, at the samples that count."""
    bounds = {pair: np.full(len(counted), np.inf) for pair in exact}
    for n, pair in enumerate(map(tuple, found.pairs.tolist())):
        own = slice(found.stops[n], found.stops[n + 1])
        bounds[pair][found.samples[own]] = found.bounds[own]
        assert lowest(found.stops, found.bounds)[n] == own.start + found.bounds[own].argmin()
    for pair, distances in exact.items():
        known = bounds[pair] < np.inf
        assert not known[~counted].any()
        assert (bounds[pair][known] <= distances[known] + GJK).all()
        near = distances < horizon - GJK
        skipped = counted & ~known & near
        # What is left out between two samples was seen to stay where it is.
        assert not skipped.any(), pair
    return bounds


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("seed", range(6))
def test_bounds_to_pieces_and_their_neighbours(name, seed):
    """Against the exact distance to the box itself at every sample, also of those that were skipped."""
    random = np.random.default_rng(seed)
    samples, horizon = 60, 0.15
    motions = [still(samples), walk(random, samples, 0.12), walk(random, samples, 0.02)]
    bodies, R, p, placed = on_links([SHAPES[name], SHAPES["sphere"]], [1, 1], motions)
    half = random.uniform(0.02, 0.08, (2, 3))
    centres = random.normal(size=(2, 3)) * 0.03
    pieces = boxes_around([centres[i] + np.vstack([-half[i], half[i]]) for i in range(2)], 7)
    seen = follow(*seen_from(R[-1], p[-1], R, p), np.vstack([bodies.link_ends.mean(axis=1)]))
    start, stop = 3, samples - 4
    found = added(add_near_pieces, seen, bodies, pieces, np.array([[start, stop], [samples, samples]]), horizon)
    exact = {
        (0, 7 + i): np.array(
            [
                distance(
                    SHAPES[name], placed[0][k],
                    coal.Box(*(2 * half[i])), motions[-1][k] * pin.SE3(np.eye(3), centres[i]),
                )
                for k in range(samples)
            ]
        )
        for i in range(2)
    }  # fmt: skip
    counted = (np.arange(samples) >= start) & (np.arange(samples) < stop)
    check(found, exact, horizon, counted)
    # One measurement bounds all neighbours.
    for pair, distances in exact.items():
        for k in (start, (start + stop) // 2):
            bounds, at = np.full(samples, -np.inf), np.arange(samples)
            least = tighten(
                at, bounds, seen.path(1, bodies.reaches[0]), seen.path(2, pieces.reaches[pair[1] - 7]), k, distances[k]
            )
            others = np.delete(at, k)
            assert np.isposinf(bounds[k])
            assert (bounds[others] <= distances[others] + 2 * GJK).all()
            assert least == bounds.argmin()


@pytest.mark.parametrize("seed", range(8))
def test_bounds_between_capsules_are_exact_where_they_are_apart(seed):
    random = np.random.default_rng(seed)
    samples, horizon = 50, 0.2
    motions = [still(samples), *(walk(random, samples, 0.15) for _ in range(3))]
    shapes, links = [SHAPES[name] for name in ("capsule", "sphere", "cylinder", "convex")], [1, 2, 3, 3]
    bodies, R, p, placed = on_links(shapes, links, motions)
    world = follow(R, p, bodies.link_ends.mean(axis=1))
    found = added(add_near_each_other, world, bodies, np.array([[1, 2], [1, 3], [2, 3]]), horizon)
    exact = {
        (i, j): np.array([distance(shapes[i], placed[i][k], shapes[j], placed[j][k]) for k in range(samples)])
        for i, j in ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3))
    }
    bounds = check(found, exact, horizon, np.ones(samples, dtype=bool))
    known = (bounds[0, 1] < np.inf) & (exact[0, 1] > 0)
    np.testing.assert_allclose(bounds[0, 1][known], exact[0, 1][known], atol=GJK)


def test_parallel_and_crossing_segments():
    """The cases in which the nearest points of two lines are not unique, or not on the segments."""
    across, behind, above = np.array([0.5, 0, 0]), np.array([3, 0, 0]), np.array([0, 0, 1.0])
    along, turned = pin.utils.rotate("y", np.pi / 2), pin.utils.rotate("x", np.pi / 2)
    thin, ball = 1e-9, coal.Sphere(1e-9)
    rod = coal.Capsule(thin, 1.0)
    others = [
        (rod, pin.SE3(along, across + [0, 0.3, 0]), 0.3),  # parallel, overlapping
        (rod, pin.SE3(along, behind + [0, 0.4, 0]), np.hypot(2, 0.4)),  # parallel, behind
        (rod, pin.SE3(turned, 0.2 * above), 0.2),  # crossing above
        (ball, pin.SE3(np.eye(3), np.array([1.5, 2, 0])), np.hypot(1, 2)),  # a point
    ]
    for shape, placement, expected in others:
        for pair in ((0, 1), (1, 0)):
            shapes, placements = [rod, shape], [pin.SE3(along, np.zeros(3)), placement]
            bodies = bounding_bodies([shapes[i] for i in pair], [placements[i] for i in pair], np.array([0, 1]), 2)
            R, p = (np.stack(column) for column in zip(arrays(still(1)), arrays(still(1)), strict=True))
            found = added(add_near_each_other, follow(R, p, np.zeros((2, 3))), bodies, np.array([[0, 1]]), 10.0)
            np.testing.assert_allclose(found.bounds, expected, atol=3 * thin)


def test_heights_are_those_of_the_lowest_points():
    random = np.random.default_rng(1)
    samples, horizon = 30, 0.2
    motions = [still(samples), walk(random, samples, 0.3), walk(random, samples, 0.2)]
    bodies, R, p, placed = on_links([SHAPES["capsule"], SHAPES["box"]], [1, 1], motions)
    ground = coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)
    world = follow(R, p, bodies.link_ends.mean(axis=1))
    shapes, everywhere = [SHAPES["capsule"], SHAPES["box"]], np.ones(samples, dtype=bool)
    exact = {
        (i, -1): np.array([distance(shapes[i], T, ground, pin.SE3.Identity()) for T in placed[i]]) for i in range(2)
    }
    bounds = check(added(add_near_ground, world, bodies, horizon), exact, horizon, everywhere)
    known = bounds[0, -1] < np.inf
    assert known.any()
    np.testing.assert_allclose(bounds[0, -1][known], exact[0, -1][known], atol=1e-12)
    half = np.array([0.01, 0.07, 0.03])
    pieces: Pieces = boxes_around([np.vstack([-half, half])], 5)
    found = added(add_pieces_near_ground, world, pieces, 4, horizon)
    exact = {(5, -1): np.array([distance(SHAPES["box"], T, ground, pin.SE3.Identity()) for T in motions[-1]])}
    bounds = check(found, exact, horizon, np.arange(samples) >= 4)
    known = bounds[5, -1] < np.inf
    np.testing.assert_allclose(bounds[5, -1][known], exact[5, -1][known], atol=1e-12)
    # Without room for all there is no answer.
    few = space_for(1, 10000), space_for(100, samples)
    assert [add_near_ground(world, bodies, horizon, found, 0) for found in few] == [-1, -1]
    assert add_pieces_near_ground(world, pieces, 4, horizon, few[1], -1) == -1
    # What is added later leaves what was there and comes after it.
    both = space_for(100, 10000)
    first = add_near_ground(world, bodies, horizon, both, 0)
    both = first_of(both, add_pieces_near_ground(world, pieces, 4, horizon, both, first))
    alone = first_of(both, first)
    np.testing.assert_array_equal(both.pairs[first:], found.pairs)
    np.testing.assert_array_equal(both.samples[both.stops[first] :], found.samples)
    np.testing.assert_array_equal(both.bounds[both.stops[first] :], found.bounds)
    np.testing.assert_array_equal(alone.bounds, added(add_near_ground, world, bodies, horizon).bounds)


def test_volumes_around_links_contain_their_bodies():
    shapes = list(SHAPES.values())
    bodies, _, _, placed = on_links(shapes, [1, 1, 2, 2, 2, 1], [still(1)] * 3)
    middles = bodies.link_ends.mean(axis=1)
    for direction in np.random.default_rng(0).normal(size=(100, 3)):
        direction /= np.linalg.norm(direction)
        plane = coal.Halfspace(direction, 0.0)
        for b, (shape, (T,)) in enumerate(zip(shapes, placed, strict=True)):
            low, k = distance(shape, T, plane, pin.SE3.Identity()), bodies.links[b]
            assert (bodies.link_ends[k] @ direction).min() - bodies.link_radii[k] <= low + 1e-12
            assert middles[k] @ direction - bodies.reaches[b] <= low + 1e-12
            rounded = bodies.ends[b].mean(axis=0) @ direction - np.abs(bodies.halves[b] @ direction).sum()
            assert rounded - bodies.rounding[b] <= low + 1e-12
