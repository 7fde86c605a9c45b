"""Tune two controllers for one plant, run both over ROS 2 into one bag, and compare what was recorded.

python examples/compare_controllers.py bags/compared
"""

import sys

from tdof_npid_ros import analyze, load_case, run, tune

CASE = "p1-c0.5"  # or the path of your parameter file


def main(bag: str) -> None:
    """Record PID and TDOF-NPID2, then print every step's metrics."""
    case = load_case(CASE)
    with run(CASE, bag=bag) as loop:
        for controller in ("pid", "tdof_npid2"):
            loop.use(tune(case, controller, seed=1, generations=30).gains)
            loop.play()  # all episodes of the case: here setpoint and disturbance
            loop.wait()
    print(analyze([bag]).table())


if __name__ == "__main__":
    main(*sys.argv[1:])
