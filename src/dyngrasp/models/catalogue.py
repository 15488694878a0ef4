"""The models that come with the package, by name, and what there is to say about any model file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import minimize

from dyngrasp.errors import ModelFileError, UnknownName
from dyngrasp.models.camera import CameraModel, read_camera
from dyngrasp.models.gripper import GripperModel
from dyngrasp.models.gripper_file import read_gripper
from dyngrasp.models.model_file import read_toml
from dyngrasp.models.robot import RobotModel, read_robot
from dyngrasp.signals import Array

if TYPE_CHECKING:
    from dyngrasp.models.grasp_object import GraspObject

ASSETS = Path(__file__).parent / "assets"

ROBOTS: Mapping[str, Path] = MappingProxyType({"iiwa14": ASSETS / "robots" / "iiwa14"})
GRIPPERS: Mapping[str, Path] = MappingProxyType({"sdh2": ASSETS / "grippers" / "sdh2"})
OBJECTS: Mapping[str, Path] = MappingProxyType({"casting": ASSETS / "objects" / "casting"})
CAMERAS: Mapping[str, Path] = MappingProxyType({"ava1000": ASSETS / "cameras" / "ava1000"})


def load_robot(name_or_path: str | Path) -> RobotModel:
    """An arm of the catalogue, or of a user's model.toml.

    Args:
        name_or_path: A name, or the path of a model.toml or of the folder that holds one.

    Raises:
        UnknownName: Neither a name of the catalogue nor a path.
        ModelFileError: The file cannot be used.
    """
    return read_robot(_model_file("robot", name_or_path, ROBOTS))


def load_gripper(name_or_path: str | Path) -> GripperModel:
    """A hand of the catalogue, or of a user's model.toml; arguments and errors as for `load_robot`."""
    return read_gripper(_model_file("gripper", name_or_path, GRIPPERS))


def load_object(name_or_path: str | Path) -> GraspObject:
    """A part of the catalogue, or of a user's model.toml; arguments and errors as for `load_robot`."""
    from dyngrasp.models.grasp_object import read_object

    return read_object(_model_file("object", name_or_path, OBJECTS))


def load_camera(name_or_path: str | Path) -> CameraModel:
    """A camera of the catalogue, or of a user's model.toml; arguments and errors as for `load_robot`."""
    return read_camera(_model_file("camera", name_or_path, CAMERAS))


def _model_file(kind: str, name_or_path: str | Path, known: Mapping[str, Path]) -> Path:
    if str(name_or_path) in known:
        return known[str(name_or_path)] / "model.toml"
    path = Path(name_or_path)
    if path.is_dir():
        return path / "model.toml"
    # Whoever writes a suffix or a folder means a file: a missing one is then reported as missing, not as unknown.
    if path.suffix or len(path.parts) > 1:
        return path
    raise UnknownName(kind, str(name_or_path), list(known))


@dataclass(frozen=True)
class CatalogueRow:
    """One model of the catalogue, for lists.

    Attributes:
        kind: "robot", "gripper", "object" or "camera".
        name: The name to load it by.
        description: One line about it.
        path: Its model.toml.
    """

    kind: str
    name: str
    description: str
    path: Path


def catalogue() -> tuple[CatalogueRow, ...]:
    """All models of the package, robots first, then grippers, objects and cameras."""
    rows = []
    for kind, known in (("robot", ROBOTS), ("gripper", GRIPPERS), ("object", OBJECTS), ("camera", CAMERAS)):
        for name, folder in known.items():
            path = folder / "model.toml"
            rows.append(CatalogueRow(kind, name, str(read_toml(path).get("description", "")), path))
    return tuple(rows)


def check_model(path: str | Path) -> list[str]:
    """Load any model.toml by its `kind` and say what it holds.

    Args:
        path: The file, or the folder with a model.toml.

    Returns:
        Lines for people: name, joints, mass, reach, limits; aperture; grasps.

    Raises:
        ModelFileError: The file cannot be used.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "model.toml"
    kind = read_toml(path).get("kind")
    describe = {"robot": _robot_facts, "gripper": _gripper_facts, "object": _object_facts, "camera": _camera_facts}
    if kind not in describe:
        raise ModelFileError(path, "kind", kind, "one of " + ", ".join(f'"{name}"' for name in describe))
    return describe[kind](path)


def _robot_facts(path: Path) -> list[str]:
    robot = read_robot(path)
    limits = robot.limits
    facts = [
        f"robot {robot.name}: {robot.description}" if robot.description else f"robot {robot.name}",
        f"{robot.n} joints, {robot.kinematics} kinematics, {robot.mass:.2f} kg",
        f"the flange reaches {reach(robot):.3f} m from the shoulder",
    ]
    lower, upper, speed = (np.rad2deg(x) for x in (limits.position_lower, limits.position_upper, limits.velocity))
    facts += [
        f"{name}: {lower[i]:.4g} to {upper[i]:.4g} deg, {speed[i]:.4g} deg/s, {limits.torque[i]:.4g} Nm"
        + (f", {np.rad2deg(limits.acceleration[i]):.4g} deg/s²" if np.isfinite(limits.acceleration[i]) else "")
        + (f", of which {limits.coriolis[i]:.4g} Nm kept for Coriolis torques" if limits.coriolis[i] else "")
        for i, name in enumerate(robot.joint_names)
    ]
    if not limits.coriolis.any():
        facts.append("no Coriolis bounds: torque rows are not tightened (limits.coriolis_bound_nm)")
    return facts


def reach(robot: RobotModel, starts: int = 8) -> float:
    """Largest distance (m) of the flange from the second joint, the shoulder: found by ascent from random postures."""
    if robot.n < 2:
        return float(np.linalg.norm(robot.T_last_flange.translation))
    shoulder = robot.pin_model.jointPlacements[1] * robot.pin_model.jointPlacements[2]
    lower, upper = robot.limits.position_lower, robot.limits.position_upper

    def descend(q: Array) -> tuple[float, Array]:
        q = np.concatenate([[0.0], q])  # the first joint carries the shoulder along
        arm = robot.forward_kinematics(q).translation - shoulder.translation
        return -float(arm @ arm), -2 * arm @ robot.jacobian(q)[:3, 1:]

    random = np.random.default_rng(0)
    bounds = list(zip(lower[1:], upper[1:], strict=True))
    found = [
        minimize(descend, random.uniform(lower[1:], upper[1:]), jac=True, method="L-BFGS-B", bounds=bounds)
        for _ in range(starts)
    ]
    return float(np.sqrt(max(-result.fun for result in found)))


def _gripper_facts(path: Path) -> list[str]:
    gripper = read_gripper(path)
    facts = [
        f"gripper {gripper.name}: {gripper.description}" if gripper.description else f"gripper {gripper.name}",
        f"{gripper.m} planned joints ({', '.join(gripper.joint_names)}), {len(gripper.locked)} locked, "
        f"{gripper.inertia(gripper.open_posture).mass:.2f} kg",
        f"opens to {gripper.max_aperture * 1e3:.1f} mm, closes to {gripper.min_aperture * 1e3:.1f} mm, "
        f"{gripper.pinch_force:.3g} N a finger",
    ]
    travel = (
        gripper.grasp_point_many(np.array([gripper.closing_posture(x) for x in np.linspace(0.0, 1.0, 51)]))
        @ gripper.approach_axis
    )
    facts.append(f"the grasp point moves {np.ptp(travel) * 1e3:.1f} mm along the approach axis as the hand closes")
    return facts


def _object_facts(path: Path) -> list[str]:
    from dyngrasp.models.grasp_object import read_object

    part = read_object(path)
    return [
        f"object {part.name}: {part.spatial_inertia.mass:.3f} kg",
        f"its origin rests {part.rest_height * 1e3:.1f} mm above the ground",
        *(f"grasp {grasp.name}: {grasp.width * 1e3:.1f} mm wide" for grasp in part.grasps),
    ]


def _camera_facts(path: Path) -> list[str]:
    camera = read_camera(path)
    left_right, top_bottom = (
        np.rad2deg(2.0 * np.arctan(0.5 * size / focal))
        for size, focal in zip((camera.width, camera.height), camera.focal, strict=True)
    )
    x, y, z = 1e3 * camera.T_hand_camera.translation
    return [
        f"camera {camera.name}: {camera.description}" if camera.description else f"camera {camera.name}",
        f"{camera.width} x {camera.height} pixels at {camera.rate:g} Hz, exposure {camera.exposure * 1e3:g} ms",
        f"sees {left_right:.1f} x {top_bottom:.1f} deg, from ({x:.0f}, {y:.0f}, {z:.0f}) mm in the hand frame",
    ]
