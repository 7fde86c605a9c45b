"""How many closed-loop steps a second: ours, the same loop in C, and what people use."""

from __future__ import annotations

import math
import shutil
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from benchmarks.harness import Rate, Result, Verdict, main, rate, summary
from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.loop import integrals
from tdof_npid_ros.scenario import parse_plan

QUESTION = "Closed-loop steps per second (Process 1, c = 0.5, TDOF-NPID2)"
UNLIMITED = (-math.inf, math.inf)
C_SOURCE = Path(__file__).with_name("loop.c")


def run(size: str) -> Result:
    """Measure our loop, then its peers, in one run."""
    full = size == "full"
    repeats, steps = (7, 2_000_000) if full else (1, 20_000)
    case = load_case("p1-c0.5")
    result = Result(QUESTION)
    ours = {lanes: _ours(case, lanes, steps // max(1, lanes // 4), repeats) for lanes in (1, 16, 40, 64)}
    result.rates += ours.values()
    result.rates.append(_two_cores(case, 64, steps // 16, repeats))
    c = _c(steps, repeats)
    if c is None:
        result.notes.append("no C compiler on this machine: not compared with C")
    else:
        result.rates.append(c)
        result.verdicts += [
            Verdict("1 lane against C", ours[1].median / c.median, 1.0),
            Verdict("64 lanes against C", ours[64].median / c.median, 2.0),
        ]
    result.verdicts.append(Verdict("million steps per second and core, 40 lanes", ours[40].median / 1e6, 50.0))
    result.rates.append(_numpy(case, 20_000 if full else 2_000, min(repeats, 3)))
    result.rates.append(_solve_ivp(case, 2.0 if full else 0.2))
    control = _python_control(case, 5.0 if full else 0.5)
    if control is None:
        result.notes.append("python-control is not installed: not compared with it")
    else:
        result.rates.append(control)
        result.verdicts.append(Verdict("1 lane against python-control", ours[1].median / control.median, 1000.0))
    return result


def _lanes_of(gains: Gains, lanes: int) -> Gains:
    return gains.with_values(kp=tuple(gains.kp * f for f in np.linspace(0.9, 1.0, lanes))) if lanes > 1 else gains  # type: ignore[operator]


def _ours(case: Case, lanes: int, steps: int, repeats: int) -> Rate:
    signals = parse_plan(["0 setpoint 1", f"{steps * case.sample_period} end"], case.sample_period_ns).sampled(
        case.sample_period_ns
    )
    gains = _lanes_of(case.gains, lanes)
    return rate(
        f"tdof_npid_ros, {lanes} lane{'s' * (lanes > 1)}, one core", "steps/s", lanes * signals.steps,
        lambda: integrals(case.plant_at, gains, signals, UNLIMITED), repeats,
    )  # fmt: skip


def _two_cores(case: Case, lanes: int, steps: int, repeats: int) -> Rate:
    signals = parse_plan(["0 setpoint 1", f"{steps * case.sample_period} end"], case.sample_period_ns).sampled(
        case.sample_period_ns
    )
    gains = _lanes_of(case.gains, lanes)
    with ThreadPoolExecutor(2) as pool:
        return rate(
            f"tdof_npid_ros, 2 x {lanes} lanes, two cores", "steps/s", 2 * lanes * signals.steps,
            lambda: list(pool.map(lambda _: integrals(case.plant_at, gains, signals, UNLIMITED), range(2))), repeats,
        )  # fmt: skip


def _c(steps: int, repeats: int) -> Rate | None:
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "loop"
        subprocess.run([compiler, "-O3", "-march=native", str(C_SOURCE), "-o", str(program), "-lm"], check=True)
        values = [
            float(subprocess.run([program, str(steps)], capture_output=True, text=True, check=True).stdout)
            for _ in range(repeats)
        ]
    return summary("the same loop in C, -O3 -march=native", "steps/s", values)


def _numpy(case: Case, steps: int, repeats: int) -> Rate:
    """simple-pid's way: a Python controller object around a NumPy plant, one call a step."""
    from simple_pid import PID

    h = case.sample_period
    a = math.exp(-h / 5.0)
    delay = round(0.5 / h)

    def loop() -> None:
        pid = PID(10.0, 6.0, 2.9, setpoint=1.0, sample_time=None)
        x, line = np.zeros(1), np.zeros(delay + 1)
        for k in range(steps):
            u = pid(float(x[0]), dt=h)
            line[k % (delay + 1)] = u
            x = a * x + (1.0 - a) * line[(k + 1) % (delay + 1)]

    return rate("simple-pid around a NumPy plant", "steps/s", steps, loop, repeats)


def _solve_ivp(case: Case, seconds: float) -> Rate:
    """SciPy's solver, restarted each sample with the effort held."""
    from scipy.integrate import solve_ivp

    steps = round(seconds / case.sample_period)

    def loop() -> None:
        x = np.zeros(1)
        for _ in range(steps):
            u = 10.0 * (1.0 - x[0])
            x = solve_ivp(lambda t, x, u=u: (u - x) / 5.0, (0, case.sample_period), x).y[:, -1]

    return rate("SciPy solve_ivp, effort held", "steps/s", steps, loop, 1)


def _python_control(case: Case, seconds: float) -> Rate | None:
    """python-control: the interconnected nonlinear loop, fixed-step at the sample period."""
    try:
        import control
    except ImportError:
        return None
    h, delay = case.sample_period, round(0.5 / case.sample_period)
    a = math.exp(-h / 5.0)

    def plant_update(t: float, x: np.ndarray, u: np.ndarray, p: object) -> np.ndarray:
        return np.concatenate(([a * x[0] + (1 - a) * x[-1]], u[:1], x[1:-1]))

    def law_update(t: float, x: np.ndarray, u: np.ndarray, p: object) -> np.ndarray:
        e = u[0] - u[1]
        return np.array([x[0] + h * 9.4 * math.exp(-(e**2) / 2) * e, 0.8 * x[1] + 0.2 * (u[0] - u[1])])

    def law_output(t: float, x: np.ndarray, u: np.ndarray, p: object) -> np.ndarray:
        return np.array([9.4 * (0.7 * u[0] - u[1]) + x[0] + 90.0 * (u[0] - u[1] - x[1])])

    plant = control.nlsys(
        plant_update, lambda t, x, u, p: x[:1], inputs=["u"], outputs=["y"], states=delay + 1, dt=h, name="plant"
    )
    law = control.nlsys(law_update, law_output, inputs=["r", "y"], outputs=["u"], states=2, dt=h, name="law")
    closed = control.interconnect([plant, law], inputs=["r"], outputs=["y"])
    t = np.arange(0, seconds, h)
    return rate(
        "python-control, input_output_response", "steps/s", len(t),
        lambda: control.input_output_response(closed, t, np.ones_like(t)), 1,
    )  # fmt: skip


if __name__ == "__main__":
    main(run)
