"""Arms made from random numbers, so that nothing can rest on the iiwa's parallel axes; MuJoCo as the second opinion."""

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.models.catalogue import load_gripper, load_robot
from dyngrasp.models.gripper import GripperModel
from dyngrasp.models.robot import RobotModel, read_robot

HAND_AND_PART = pin.Inertia(2.7, np.array([0.02, -0.03, 0.13]), np.array([[30, 2, 1], [2, 28, -3], [1, -3, 12]]) * 1e-3)


def numbers(values: np.ndarray) -> str:
    return " ".join(f"{x:.17g}" for x in np.ravel(values))


def toml_numbers(values: np.ndarray) -> str:
    return "[" + ", ".join(f"{x:.17g}" for x in np.ravel(values)) + "]"


def write_chain(folder: Path, n: int, seed: int, description: str = "mjcf") -> Path:
    """A serial arm with joints at random places about random axes, written as MJCF or as URDF."""
    random = np.random.default_rng(seed)
    opening, closing, urdf = "", "", "<link name='base'/>"
    parent = "base"
    armature = random.uniform(0.01, 0.3, n)
    for i in range(n):
        rotation = pin.exp3(random.normal(size=3))
        quaternion = pin.Quaternion(rotation)
        rpy = pin.rpy.matrixToRpy(rotation)
        position = random.uniform(-0.2, 0.2, 3) + [0, 0, 0.15]
        axis = random.normal(size=3)
        axis /= np.linalg.norm(axis)
        mass, com = random.uniform(0.5, 5.0), random.uniform(-0.1, 0.1, 3)
        half = random.normal(size=(3, 3))
        spread = 0.003 * (half @ half.T) + 0.005 * np.eye(3)
        inertia = np.trace(spread) * np.eye(3) - spread  # of masses spread like this: a body that can exist
        xx, yy, zz, xy, xz, yz = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        wxyz = np.array([quaternion.w, quaternion.x, quaternion.y, quaternion.z])
        opening += (
            f"<body name='link_{i}' pos='{numbers(position)}' quat='{numbers(wxyz)}'>"
            f"<joint name='joint_{i}' axis='{numbers(axis)}' range='-3 3' armature='{armature[i]:.17g}'/>"
            f"<inertial pos='{numbers(com)}' mass='{mass:.17g}' "
            f"fullinertia='{numbers(np.array([xx, yy, zz, xy, xz, yz]))}'/>"
        )
        closing += "</body>"
        urdf += (
            f"<link name='link_{i}'><inertial><origin xyz='{numbers(com)}'/><mass value='{mass:.17g}'/>"
            f"<inertia ixx='{xx:.17g}' iyy='{yy:.17g}' izz='{zz:.17g}' ixy='{xy:.17g}' ixz='{xz:.17g}' "
            f"iyz='{yz:.17g}'/></inertial></link>"
            f"<joint name='joint_{i}' type='revolute'><parent link='{parent}'/><child link='link_{i}'/>"
            f"<origin xyz='{numbers(position)}' rpy='{numbers(rpy)}'/><axis xyz='{numbers(axis)}'/>"
            f"<limit lower='-3' upper='3' effort='100' velocity='2'/></joint>"
        )
        parent = f"link_{i}"
    xml = (
        "<mujoco><compiler angle='radian'/><worldbody>"
        f"{opening}<site name='tip' pos='0.01 0.02 0.08' quat='0.8 0.6 0 0'/>{closing}</worldbody></mujoco>"
    )
    tip = pin.rpy.matrixToRpy(pin.Quaternion(0.8, 0.6, 0.0, 0.0).matrix())
    urdf = (
        f"<robot name='chain'>{urdf}<link name='tip'/><joint name='to_tip' type='fixed'><parent link='{parent}'/>"
        f"<child link='tip'/><origin xyz='0.01 0.02 0.08' rpy='{numbers(tip)}'/></joint></robot>"
    )
    (folder / "arm.xml").write_text(xml)
    (folder / "arm.urdf").write_text(urdf)
    source = "mjcf = 'arm.xml'" if description == "mjcf" else "urdf = 'arm.urdf'"
    own = f"armature_kg_m2 = {toml_numbers(armature)}" if description == "urdf" else ""
    (folder / "model.toml").write_text(
        f"kind = 'robot'\nname = 'chain{n}'\n{source}\ntip_frame = 'tip'\n{own}\n[limits]\n"
        f"position_lower_deg = {toml_numbers(np.full(n, -170.0))}\n"
        f"position_upper_deg = {toml_numbers(np.full(n, 170.0))}\n"
        f"velocity_deg_per_s = {toml_numbers(np.full(n, 100.0))}\ntorque_nm = {toml_numbers(np.full(n, 200.0))}\n"
    )
    return folder / "model.toml"


@pytest.fixture
def make_chain(tmp_path: Path) -> Callable[..., Path]:
    """Writes a random chain into a folder of its own: (n, seed, description) → its model.toml."""

    def make(n: int, seed: int = 0, description: str = "mjcf") -> Path:
        folder = tmp_path / f"{description}_{n}_{seed}"
        folder.mkdir()
        return write_chain(folder, n, seed, description)

    return make


@pytest.fixture(scope="session", params=["iiwa14", "chain6", "chain7", "chain8"])
def robot(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    if request.param == "iiwa14":
        return load_robot("iiwa14")
    n = int(request.param.removeprefix("chain"))
    return read_robot(write_chain(tmp_path_factory.mktemp(request.param), n, seed=n))


@pytest.fixture(scope="session")
def gripper() -> GripperModel:
    return load_gripper("sdh2")


@pytest.fixture(scope="session")
def payload() -> pin.Inertia:
    """About what the arm carries with hand and part, without any symmetry."""
    return HAND_AND_PART


def free_of_constraints(spec: mujoco.MjSpec) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Compiled so that inverse dynamics is that of the bare tree: no contacts, limits, damping or friction."""
    model = spec.compile()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    model.dof_damping[:] = 0.0
    model.dof_frictionloss[:] = 0.0
    return model, mujoco.MjData(model)


@pytest.fixture(scope="session")
def mujoco_arm() -> Callable[..., tuple[mujoco.MjModel, mujoco.MjData]]:
    """(robot, payload or None) → the arm in MuJoCo, the payload a body of its own behind the flange site."""

    def build(robot: RobotModel, payload: pin.Inertia | None = None) -> tuple[mujoco.MjModel, mujoco.MjData]:
        spec = mujoco.MjSpec.from_file(str(robot.mjcf_path))
        if payload is not None:
            site = spec.site(robot.tip_frame)
            body = site.parent.add_body(name="payload", pos=site.pos, quat=site.quat)
            xx, yy, zz, xy, xz, yz = payload.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
            body.mass, body.ipos, body.fullinertia = payload.mass, payload.lever, [xx, yy, zz, xy, xz, yz]
            body.explicitinertial = True
        return free_of_constraints(spec)

    return build
