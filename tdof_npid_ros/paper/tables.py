"""The published tables, as printed in the paper."""

from __future__ import annotations

from typing import NamedTuple

from tdof_npid_ros.control.gains import ControllerType, Gains

CASE_TITLES = {
    "p1-c0.5": "Process 1, c = 0.5",
    "p1-c4": "Process 1, c = 4",
    "p2-c2": "Process 2, c = 2",
    "p2-c5": "Process 2, c = 5",
    "p3-c1": "Process 3, c = 1",
    "p3-c2": "Process 3, c = 2",
    "sprott": "Sprott circuit",
}
CASES = tuple(CASE_TITLES)
COMPARED: tuple[ControllerType, ...] = ("pid", "tdof_npid1", "tdof_npid2")
SIGMA = 1.0  # "the biggest change in the setpoint value between steps": a unit step everywhere


class Published(NamedTuple):
    """One row: tuned parameters (Tables 1, 3, 5, 7) and performance (Tables 2, 4, 6, 8)."""

    case: str
    controller: ControllerType
    kp: float
    ki: float
    kd: float
    alpha: float
    beta: float
    overshoot_percent: float
    settling_time_s: float
    iae_setpoint: float
    peak: float
    recovery_time_s: float
    iae_disturbance: float

    @property
    def gains(self) -> Gains:
        """The published gains."""
        return Gains(self.controller, self.kp, self.ki, self.kd, self.alpha, self.beta, SIGMA)

    @property
    def objective(self) -> float:
        """Equation (10) with w = 1."""
        return self.iae_setpoint + self.iae_disturbance


ROWS: tuple[Published, ...] = tuple(
    Published(*row)
    for row in (
        # case, controller, kp, ki, kd, alpha, beta, Mp, ts, IAE_SP, Mpeak, trcy, IAE_DIS
        ("p1-c0.5", "pid", 10.051, 6.352, 2.920, 0, 0, 57.8845, 2.9543, 1.0137, 0.1072, 4.0992, 0.1590),
        ("p1-c0.5", "tdof_npid1", 9.415, 9.431, 2.104, 0.323, 0, 7.0183, 1.4283, 0.7260, 0.1134, 3.9832, 0.1436),
        ("p1-c0.5", "tdof_npid2", 9.426, 9.435, 2.108, 0.322, 0.005, 7.0493, 1.4289, 0.7265, 0.1134, 3.9809, 0.1433),
        ("p1-c4", "pid", 1.521, 0.298, 2.307, 0, 0, 42.0755, 19.6993, 6.3219, 0.5602, 14.9615, 3.6078),
        ("p1-c4", "tdof_npid1", 1.517, 0.333, 2.270, 0.069, 0, 23.5261, 19.7430, 5.9877, 0.5603, 14.9092, 3.6289),
        ("p1-c4", "tdof_npid2", 1.528, 0.336, 2.303, 0.095, 0.191, 18.6655, 19.7788, 5.9855, 0.5602, 14.7934, 3.6041),
        ("p2-c2", "pid", 2.724, 0.887, 3.117, 0, 0, 32.404, 5.169, 2.476, 0.305, 9.439, 1.221),
        ("p2-c2", "tdof_npid1", 2.660, 1.124, 3.082, 0.080, 0, 19.277, 7.081, 2.309, 0.305, 12.899, 1.208),
        ("p2-c2", "tdof_npid2", 3.207, 1.289, 3.601, 0.214, 0.483, 9.648, 9.239, 2.409, 0.286, 12.257, 0.945),
        ("p2-c5", "pid", 7.220, 1.166, 15.185, 0, 0, 40.942, 6.552, 3.134, 0.121, 16.562, 0.887),
        ("p2-c5", "tdof_npid1", 5.724, 2.083, 14.208, 0.241, 0, 19.186, 6.050, 2.609, 0.129, 27.783, 1.024),
        ("p2-c5", "tdof_npid2", 9.351, 2.848, 16.773, 0.338, 0.506, 10.311, 7.954, 2.784, 0.106, 15.006, 0.524),
        ("p3-c1", "pid", 1.190, 0.516, 1.088, 0, 0, 23.607, 5.153, 2.912, 0.678, 7.608, 2.367),
        ("p3-c1", "tdof_npid1", 1.294, 0.654, 1.120, 0.299, 0, 7.489, 6.897, 2.813, 0.670, 9.951, 2.418),
        ("p3-c1", "tdof_npid2", 1.349, 0.707, 1.211, 0.366, 0.257, 6.051, 3.105, 2.810, 0.699, 6.506, 2.176),
        ("p3-c2", "pid", 0.701, 0.280, 0.618, 0, 0, 12.878, 5.996, 4.193, 1.169, 9.633, 5.156),
        ("p3-c2", "tdof_npid1", 0.742, 0.334, 0.617, 0.124, 0, 4.485, 8.387, 4.212, 1.248, 12.084, 5.411),
        ("p3-c2", "tdof_npid2", 0.750, 0.340, 0.634, 0.150, 0.122, 4.289, 7.889, 4.216, 1.247, 8.562, 5.060),
        ("sprott", "pid", 673.645, 296.037, 86.752, 0, 0, 46.794, 0.886, 0.497, 0.008, 11.204, 0.039),
        ("sprott", "tdof_npid1", 465.547, 368.178, 81.294, 0.147, 0, 4.096, 0.415, 0.263, 0.008, 8.216, 0.032),
        ("sprott", "tdof_npid2", 675.422, 388.217, 131.163, 0.123, 0.296, 0.024, 0.542, 0.279, 0.007, 9.511, 0.030),
    )
)


class PublishedVariation(NamedTuple):
    """One entry of Table 9: the Sprott circuit's `a` changes from 0.6 at 5 s."""

    controller: ControllerType
    a: float
    peak: float
    recovery_time_s: float
    iae: float


VARIATIONS: tuple[PublishedVariation, ...] = (
    PublishedVariation("pid", 0.72, 0.15537e-3, 15.4397, 0.75065e-3),
    PublishedVariation("tdof_npid1", 0.72, 0.17573e-3, 12.3859, 0.60357e-3),
    PublishedVariation("tdof_npid2", 0.72, 0.14086e-3, 13.7129, 0.57241e-3),
    PublishedVariation("pid", 0.48, 0.1938e-3, 17.3791, 1.1259e-3),
    PublishedVariation("tdof_npid1", 0.48, 0.2098e-3, 14.4812, 0.9053e-3),
    PublishedVariation("tdof_npid2", 0.48, 0.1721e-3, 15.7315, 0.8586e-3),
)


def published(case: str, controller: ControllerType) -> Published | None:
    """The published row, if the paper has one."""
    return next((row for row in ROWS if (row.case, row.controller) == (case, controller)), None)
