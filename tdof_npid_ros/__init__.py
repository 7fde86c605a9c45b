"""Nonlinear two-degree-of-freedom PID control loops as ROS 2 nodes.

    from tdof_npid_ros import load_case, margins, simulate, tune

    case = load_case("p1-c0.5")
    response = simulate(case, "setpoint")              # time, setpoint, output, control_effort: NumPy arrays
    better = tune(case, "tdof_npid2", seed=1).gains
    print(margins(case, better).m_s)

These names are stable: scripts may rely on them. Each is loaded when it is first used, so `import tdof_npid_ros`
costs next to nothing. `docs/python.md` has an example of each.
"""

from __future__ import annotations

import importlib

TYPE_CHECKING = False  # as `typing` has it, which takes longer to import than all else here
if TYPE_CHECKING:
    from tdof_npid_ros.analysis.report import analyze as analyze
    from tdof_npid_ros.case import Case as Case
    from tdof_npid_ros.case import load_case as load_case
    from tdof_npid_ros.case import make_case as make_case
    from tdof_npid_ros.control.gains import Gains as Gains
    from tdof_npid_ros.control.options import ControllerOptions as ControllerOptions
    from tdof_npid_ros.graph.running import run as run
    from tdof_npid_ros.interface import read_bag as read_bag
    from tdof_npid_ros.interface import robust as robust
    from tdof_npid_ros.interface import simulate as simulate
    from tdof_npid_ros.interface import sweep as sweep
    from tdof_npid_ros.interface import tune as tune
    from tdof_npid_ros.stability.certificate import certify as certify
    from tdof_npid_ros.stability.margins import margins as margins

__version__ = "0.1.0"

_HOMES = {
    "Case": "case",
    "ControllerOptions": "control.options",
    "Gains": "control.gains",
    "analyze": "analysis.report",
    "certify": "stability.certificate",
    "load_case": "case",
    "make_case": "case",
    "margins": "stability.margins",
    "read_bag": "interface",
    "robust": "interface",
    "run": "graph.running",
    "simulate": "interface",
    "sweep": "interface",
    "tune": "interface",
}
__all__ = [*_HOMES]


def __getattr__(name: str) -> object:
    """A public name, from where it lives."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    """The public names, for completion."""
    return [*globals(), *_HOMES]
