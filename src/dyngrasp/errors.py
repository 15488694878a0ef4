"""Typed errors: misuse raises one of these; an expected numerical failure is data (`Solution.status`)."""

from __future__ import annotations

from pathlib import Path


class DyngraspError(Exception):
    """Everything the package raises on purpose; the command line turns it into one message and exit status 2."""


class InputFileError(DyngraspError):
    """A file cannot be used as it is.

    Args:
        file: The file as the user named it.
        key: Dotted path of the offending key, or None if the file as a whole is at fault.
        value: The value found there, or None.
        expected: What would be valid, in words.
    """

    def __init__(self, file: str | Path, key: str | None, value: object, expected: str) -> None:
        self.file, self.key, self.value, self.expected = str(file), key, value, expected
        found = "" if value is None else f" = {value!r}"
        where = f"{file}: " + (f"`{key}`{found}: " if key else "")
        super().__init__(where + expected)


class ModelFileError(InputFileError):
    """A robot, gripper or object file is malformed or physically impossible."""


class ScenarioError(InputFileError):
    """A scenario file or an override is malformed."""


class PlanFileError(InputFileError):
    """A stored plan cannot be read."""


class UnknownName(DyngraspError):
    """A name that the catalogue does not hold.

    Args:
        kind: "robot", "gripper", "object", …
        name: The name asked for.
        known: The valid choices.
    """

    def __init__(self, kind: str, name: str, known: list[str]) -> None:
        self.kind, self.name, self.known = kind, name, sorted(known)
        super().__init__(f"no {kind} called {name!r}; valid: {', '.join(self.known)}")


class InvalidTrajectory(DyngraspError):
    """Arrays that do not make a trajectory or a plan: shapes, order of time, or joins that do not meet."""


class InvalidProblem(DyngraspError):
    """A planning problem that contradicts itself before any solver sees it (start outside the limits, N too small)."""


class OutOfReach(DyngraspError):
    """No joint configuration brings the tip to the pose.

    Args:
        what: Which pose was asked for.
        distance: How far the pose lies outside what the arm can do (m), 0 if only joint limits forbid it.
        reason: In words.
    """

    def __init__(self, what: str, distance: float, reason: str) -> None:
        self.what, self.distance, self.reason = what, distance, reason
        super().__init__(f"{what} is out of reach: {reason}")


class GraspRefused(DyngraspError):
    """The gripper cannot take or hold the part; the message gives the number that says so."""


class RenderingUnavailable(DyngraspError):
    """The machine cannot draw off screen; the message names the package to install."""


class PlanningFailed(DyngraspError):
    """Raised by `.require()` on a result that is not a valid plan.

    Args:
        message: What failed.
        result: The `Solution` or `PlanResult` with everything known about the failure.
    """

    def __init__(self, message: str, result: object) -> None:
        self.result = result
        super().__init__(message)
