"""Dynamic grasping with online trajectory replanning: what most programs need, by one import.

Names are loaded when they are first used, so that `import dyngrasp` alone costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dyngrasp.errors import DyngraspError as DyngraspError
    from dyngrasp.models.catalogue import load_gripper as load_gripper
    from dyngrasp.models.catalogue import load_object as load_object
    from dyngrasp.models.catalogue import load_robot as load_robot
    from dyngrasp.planning.audit import audit as audit
    from dyngrasp.planning.collocation.planner import CollocationPlanner as CollocationPlanner
    from dyngrasp.planning.collocation.planner import CollocationSettings as CollocationSettings
    from dyngrasp.planning.grasp_targets import grasp_targets as grasp_targets
    from dyngrasp.planning.grasp_task import GraspTask as GraspTask
    from dyngrasp.planning.grasp_task import TaskSettings as TaskSettings
    from dyngrasp.planning.problem import Status as Status
    from dyngrasp.planning.replanning.replanner import Replanner as Replanner
    from dyngrasp.planning.replanning.target_update import updated_targets as updated_targets
    from dyngrasp.trajectory import GraspPlan as GraspPlan
    from dyngrasp.trajectory import Trajectory as Trajectory

__version__ = "0.1.0"

_HOMES = {
    "DyngraspError": "dyngrasp.errors",
    "load_gripper": "dyngrasp.models.catalogue",
    "load_object": "dyngrasp.models.catalogue",
    "load_robot": "dyngrasp.models.catalogue",
    "audit": "dyngrasp.planning.audit",
    "CollocationPlanner": "dyngrasp.planning.collocation.planner",
    "CollocationSettings": "dyngrasp.planning.collocation.planner",
    "GraspTask": "dyngrasp.planning.grasp_task",
    "TaskSettings": "dyngrasp.planning.grasp_task",
    "grasp_targets": "dyngrasp.planning.grasp_targets",
    "Replanner": "dyngrasp.planning.replanning.replanner",
    "Status": "dyngrasp.planning.problem",
    "GraspPlan": "dyngrasp.trajectory",
    "Trajectory": "dyngrasp.trajectory",
    "updated_targets": "dyngrasp.planning.replanning.target_update",
}

__all__ = ["__version__", *_HOMES]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'dyngrasp' has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
