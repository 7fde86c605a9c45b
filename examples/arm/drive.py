"""Drive six joints of the arm with one controller, recorded; then measure what was recorded.

python examples/arm/drive.py bags/arm

The arm may run in a terminal of its own as well (`python examples/arm/arm.py`): it is a node like any other.
"""

import sys
from pathlib import Path

from arm import Arm

from tdof_npid_ros import analyze, run

PARAMETERS = Path(__file__).with_name("controller.yaml")
ROBOT = {"output": "joint_states", "control_effort": "efforts"}


def main(bag: str) -> None:
    """Let the controller hold the arm; then step three of the joints, then another one."""
    with run(PARAMETERS, bag=bag, nodes=("controller",), remap=ROBOT) as loop:
        arm = Arm(context=loop.node.context)
        loop.add_node(arm)
        loop.wait_until(lambda: arm.time > 1.0)
        loop.publish("setpoint", 0.5, -0.2, 0.9, joints=("base", "shoulder", "elbow"))
        loop.wait_until(lambda: arm.time > 3.0)
        loop.publish("setpoint", 0.4, joints=("wrist_pitch",))
        loop.wait_until(lambda: arm.time > 5.0)
    print(analyze([bag]).table())


if __name__ == "__main__":
    main(*sys.argv[1:])
