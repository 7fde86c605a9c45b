"""Try eight gains at once, one per lane of a single loop over ROS 2.

python examples/gain_sweep.py bags/sweep

The same sweep in process gives the same numbers, to the last bit: `sweep` takes thousands of gains in a second.
"""

import sys

import numpy as np

from tdof_npid_ros import analyze, load_case, run, sweep

CASE = "p1-c0.5"
KP = np.linspace(6.0, 13.0, 8)


def main(bag: str) -> None:
    """Print overshoot and IAE for each gain."""
    with run(CASE, bag=bag, lanes=len(KP), kp=KP) as loop:
        loop.play("setpoint")
        loop.wait()
    (found,) = analyze([bag]).episodes
    for lane, kp in enumerate(KP):
        metrics = found.metrics(lane)
        print(f"kp {kp:5.2f}   overshoot {metrics.overshoot_percent:5.2f} %   IAE {metrics.iae:.4f}")
    in_process = sweep(load_case(CASE), "setpoint", kp=KP)
    print(f"recorded = in process, bit for bit: {np.array_equal(found.episode.output, in_process.output)}")


if __name__ == "__main__":
    main(*sys.argv[1:])
