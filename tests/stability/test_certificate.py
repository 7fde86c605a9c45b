"""The certificate: against the theory's printed values, dense grids, eigenvalues and the simulation."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from loops import Loop, closed_loop_matrix, random_loop, re_g, spectral_radius

from tdof_npid_ros import loop as closed_loop
from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.cli import main
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.control.options import ControllerOptions
from tdof_npid_ros.paper.tables import ROWS, Published
from tdof_npid_ros.paper.tuned import tuned
from tdof_npid_ros.plants.linear import TransferFunction
from tdof_npid_ros.scenario import SampledPlan, Segment
from tdof_npid_ros.stability.certificate import Certificate, certify
from tdof_npid_ros.stability.characteristic import characteristic
from tdof_npid_ros.stability.creep import creep_time
from tdof_npid_ros.stability.margins import margins
from tdof_npid_ros.stability.plant import loop_plant

LONG = bool(os.environ.get("TDOF_NPID_LONG"))
LOOPS = 1000 if LONG else 60
STARTS = 200 if LONG else 6
pytestmark = pytest.mark.timeout(3600 if LONG else 120)
MOST_DELAY = 80  # samples: of random loops, for the eigenvalues' sake
LINEAR_ROWS = [row for row in ROWS if row.case != "sprott"]
NAMES = [f"{row.case}-{row.controller}" for row in LINEAR_ROWS]
WITHOUT_LIMITS_ONLY = {
    *(("p1-c0.5", kind) for kind in ("pid", "tdof_npid1", "tdof_npid2")),
    *(("p2-c5", kind) for kind in ("tdof_npid1", "tdof_npid2")),
}


def gains_of(row: Published, **changes: object) -> Gains:
    """The printed gains, on a controller without limits."""
    return row.gains.with_values(**changes)


def case_of(loop: Loop) -> Case:
    """A loop as a case without a file."""
    plant = loop.plant
    values = {
        "numerator": list(plant.numerator),
        "denominator": list(plant.denominator),
        "dead_time": plant.dead_time,
    }
    return Case(
        "mine", round(loop.period * 1e9), "transfer_function", values, (-math.inf, math.inf), loop.gains, {}
    )  # fmt: skip


@pytest.mark.parametrize("row", LINEAR_ROWS, ids=NAMES)
def test_every_printed_linear_row_is_certified(row: Published) -> None:
    found = certify(load_case(row.case), gains_of(row))
    assert found.is_certified
    assert found.method == ("multiplier" if (row.case, row.controller) == ("p2-c5", "tdof_npid1") else "circle")
    assert found.re_g_least_at == 0.0  # on all of them the least Re G is that for ω → 0


@pytest.mark.parametrize(
    ("case", "controller", "m_s", "m_t", "re_g_zero", "k_max"),
    [
        ("p1-c0.5", "pid", 3.56, 2.57, -0.440, 2.28),
        ("p1-c4", "tdof_npid2", 2.46, 1.49, -0.595, 1.68),
        ("p2-c2", "tdof_npid1", 2.24, 1.42, -0.679, 1.47),
        ("p2-c5", "tdof_npid1", 2.03, 1.84, -1.162, 1.934),
        ("p3-c1", "tdof_npid2", 3.15, 2.23, -0.670, 1.49),
    ],
)
def test_the_table_of_margins_and_bounds(
    case: str, controller: str, m_s: float, m_t: float, re_g_zero: float, k_max: float
) -> None:
    row = next(row for row in ROWS if (row.case, row.controller) == (case, controller))
    found = certify(load_case(case), gains_of(row))
    assert found.margins is not None
    assert found.margins.m_s == pytest.approx(m_s, abs=0.005)
    assert found.margins.m_t == pytest.approx(m_t, abs=0.005)
    assert found.re_g_zero == pytest.approx(re_g_zero, abs=0.0005)
    assert found.k_max == pytest.approx(k_max, abs=0.0005 if found.method == "multiplier" else 0.005)
    if found.method == "multiplier":
        assert found.q == pytest.approx(521, abs=0.5)
        assert (found.q_low, found.q_high) == (pytest.approx(131, abs=0.5), pytest.approx(1238, abs=0.5))
        assert found.re_g_zero is not None and -1 / found.re_g_zero == pytest.approx(0.86, abs=0.005)


@pytest.mark.parametrize("row", LINEAR_ROWS, ids=NAMES)
def test_with_effort_limits_and_back_calculation_thirteen_rows_are_certified(row: Published) -> None:
    gains = gains_of(row, effort_min=-5.0, effort_max=5.0, anti_windup="back_calculation")
    found = certify(load_case(row.case), gains)
    assert found.limits
    assert found.is_certified == ((row.case, row.controller) not in WITHOUT_LIMITS_ONLY)
    assert certify(load_case(row.case), gains.with_values(anti_windup="none")).status == "not certified"
    assert certify(load_case(row.case), gains.with_values(anti_windup="conditional")).status == "not covered"


def held(values: np.ndarray, steps: int, first: int, name: str, signals: dict[str, np.ndarray]) -> None:
    """A signal that jumps through some values in its first samples and then stays at the last."""
    signals[name] = np.full(steps + 1, values[-1])
    signals[name][:first] = np.repeat(values, -(-first // len(values)))[:first]


def starts(
    rng: np.random.Generator, case: Case, found: Certificate, sizes: tuple[float, float]
) -> Iterator[SampledPlan]:
    """Setpoint and disturbance that jump about, which brings the loop into some state, and then are constant."""
    assert found.creep is not None or found.margins is not None
    slow = found.margins.time_constant_s if found.margins and found.margins.time_constant_s else 1.0
    tau = found.creep.time_constant_s if found.creep else slow
    jumps = round(5 * slow / case.sample_period)
    for _ in range(STARTS):
        steps = jumps + round((40 * slow + 30 * tau) / case.sample_period)
        if found.creep:
            steps += round(1.3 * found.creep.from_sigma_s["4"] / case.sample_period)
        signals: dict[str, np.ndarray] = {}
        held(rng.uniform(-sizes[0], sizes[0], 4), steps, jumps, "setpoint", signals)
        held(rng.uniform(-sizes[1], sizes[1], 4), steps, jumps, "disturbance", signals)
        yield SampledPlan(case.sample_period_ns, **signals, segments=(Segment(0, steps, {}),))


@pytest.mark.parametrize("row", LINEAR_ROWS, ids=NAMES)
def test_a_certified_loop_comes_to_rest_from_wherever_it_is(row: Published) -> None:
    case, gains = load_case(row.case), gains_of(row)
    found = certify(case, gains)
    for signals in starts(np.random.default_rng(1), case, found, (2.0, 1.5)):
        run = closed_loop.simulate(case.plant_at, gains, signals, case.effort_limits)
        assert abs(run.output[-1, 0] - signals.setpoint[-1]) < 1e-3


@pytest.mark.parametrize("row", [row for row in LINEAR_ROWS if row.case in ("p1-c4", "p3-c1")])
def test_a_loop_that_is_certified_with_limits_comes_to_rest_within_them(row: Published) -> None:
    case = load_case(row.case)
    gains = gains_of(row, effort_min=-2.5, effort_max=2.5, anti_windup="back_calculation")
    found = certify(case, gains)
    assert found.is_certified and found.limits
    for signals in starts(np.random.default_rng(2), case, found, (1.2, 1.0)):
        run = closed_loop.simulate(case.plant_at, gains, signals, case.effort_limits)
        assert abs(run.output[-1, 0] - signals.setpoint[-1]) < 1e-3


def random_loops() -> Iterator[tuple[Loop, float]]:
    """Loops, a third of them with a K_i near a bound: of the circle criterion, or of the linear loop's stability.

    With each the factor that brought it there, 0 for none.
    """
    rng = np.random.default_rng(7)
    count = 0
    while count < LOOPS:
        loop = random_loop(rng)
        if loop.sampled.delay > MOST_DELAY or not loop.gains.ki:
            continue
        if count % 9 == 4:
            loop = near_resonance(loop, 10 ** rng.uniform(-4.5, -2)) or loop
        if count % 3 == 0:
            bound = bound_of(loop, linear=bool(count % 2))
            if bound is not None:
                for factor in (0.99, 1.01):
                    yield loop._replace(gains=loop.gains.with_values(ki=loop.gains.ki * bound * factor)), factor  # type: ignore[operator]
                    count += 1
                continue
        yield loop, 0.0
        count += 1


def pd_radius(loop: Loop, kp: float) -> float:
    """The spectral radius without integral action; K_d keeps its proportion."""
    gains = loop.gains
    kd = 0.0 if gains.kd == 0 else gains.kd * kp / gains.kp  # type: ignore[operator]
    return spectral_radius(loop._replace(gains=gains.with_values(kp=kp, ki=0.0, kd=kd)))


def near_resonance(loop: Loop, short: float) -> Loop | None:
    """The same plant with so large a K_p that the PD loop's spectral radius is 1 - short."""
    kp = float(loop.gains.kp or 1.0)  # type: ignore[arg-type]
    if pd_radius(loop, kp) >= 1 - short:
        return None
    low, high = kp, kp
    while pd_radius(loop, high) < 1 - short:
        low, high = high, 2 * high
        if high > 1e4 * kp or abs(high) > 1e6:
            return None
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if pd_radius(loop, middle) < 1 - short else (low, middle)
    kd = 0.0 if loop.gains.kd == 0 else loop.gains.kd * low / loop.gains.kp  # type: ignore[operator]
    return loop._replace(gains=loop.gains.with_values(kp=low, kd=kd))


def bound_of(loop: Loop, linear: bool) -> float | None:
    """By what factor K_i may grow until the linear loop is unstable, or until the circle criterion fails."""
    if pd_radius(loop, float(loop.gains.kp)) >= 1:  # type: ignore[arg-type]
        return None
    if not linear:
        found = certify(case_of(loop), loop.gains)
        return found.k_max if found.method == "circle" else None
    low, high = 1e-6, 1e6
    stable = [spectral_radius(with_ki(loop, k)) < 1 for k in (low, high)]
    if stable != [True, False]:
        return None
    for _ in range(40):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if spectral_radius(with_ki(loop, middle)) < 1 else (low, middle)
    return low


def with_ki(loop: Loop, factor: float) -> Loop:
    return loop._replace(gains=loop.gains.with_values(ki=loop.gains.ki * factor))  # type: ignore[operator]


def dense_grid_passes(loop: Loop) -> bool:
    """Whether 1 + Re G is above 0 on a dense grid with points at the PD loop's poles, and the PD loop is stable."""
    pd = loop._replace(gains=loop.gains.with_values(ki=0.0))
    poles = np.linalg.eigvals(closed_loop_matrix(pd))
    if np.max(np.abs(poles)) >= 1:
        return False
    close = poles[(np.abs(poles) > 0.5) & (poles.imag >= 0)]
    near = [np.angle(p) + (1 - abs(p)) * np.linspace(-20, 20, 401) for p in close]
    omega = np.concatenate([np.geomspace(1e-5, np.pi, 30000), *near])
    omega = omega[(omega > 1e-6) & (omega <= np.pi)]
    return bool(np.min(1 + re_g(loop, omega)) > 0)


def test_of_random_loops_no_unstable_one_is_certified_and_those_that_pass_are() -> None:
    passed = certified = close = 0
    for loop, factor in random_loops():
        found = certify(case_of(loop), loop.gains)
        if found.is_certified:
            for k in (0.01, 0.1, 0.4, 1.0):  # a constant k(e) is within the class
                assert spectral_radius(with_ki(loop, k)) < 1, (loop, k)
        passes = dense_grid_passes(loop)
        if found.method == "circle":
            assert passes, loop
        passed += passes
        certified += passes and found.method == "circle"
        close += factor != 0.0
    assert close > LOOPS // 5
    assert passed > LOOPS // 4
    assert certified >= 0.95 * passed


def test_a_pd_loop_close_to_the_border_is_seen_between_the_points_of_any_grid() -> None:
    loop = Loop(TransferFunction((1.0,), (5.0, 1.0), 0.5), Gains("npid", 9.0, 0.02), 0.01)
    sharp = near_resonance(loop, 4e-5)
    assert sharp is not None
    assert pd_radius(sharp, float(sharp.gains.kp)) == pytest.approx(0.99996, abs=1e-6)  # type: ignore[arg-type]
    peak = np.angle(max(np.linalg.eigvals(closed_loop_matrix(sharp._replace(gains=sharp.gains.with_values(ki=0.0)))),
                        key=abs))  # fmt: skip
    omega = abs(peak) + 4e-5 * np.linspace(-30, 30, 60001)
    truth = -1 / np.min(re_g(sharp, omega))
    coarse = -1 / np.min(re_g(sharp, np.linspace(0.002, np.pi, 1500)))
    beyond = with_ki(sharp, math.sqrt(truth * coarse))  # a coarse grid would pass it
    assert coarse > 1.2 * truth
    found = certify(case_of(sharp), sharp.gains)
    if found.method == "circle":
        assert found.k_max == pytest.approx(truth, rel=0.01)
    assert certify(case_of(beyond), beyond.gains).method != "circle"


def test_the_linear_loop_is_stable_for_every_gain_below_the_bound() -> None:
    for row in LINEAR_ROWS[::4]:
        case, gains = load_case(row.case), gains_of(row)
        found = certify(case, gains)
        assert found.k_max is not None
        for k in np.linspace(0.05, 0.999 * found.k_max, 8):
            loop = characteristic(loop_plant(case), gains.with_values(ki=gains.ki * k))
            assert loop.modes_outside(0.0) == 0


def test_a_row_made_unstable_is_refused() -> None:
    case = load_case("p1-c4")
    for changes, word in (
        ({"kp": 4.0}, "without its integral action"),
        ({"ki": 1.2}, "unstable"),
        ({"ki": -1e-9}, "sign"),
    ):
        if word == "sign":
            with pytest.raises(ValueError, match="differ in sign"):
                case.gains.with_values(**changes)
            continue
        found = certify(case, case.gains.with_values(**changes))
        assert found.status == "not certified" and found.claim == ()
        assert word in " ".join(found.reasons)
    row = tuned("p3-c2", "tdof_npid2")
    assert row is not None
    unstable = row.gains.with_values(kp=0.8366819494762695, ki=0.617872515857525, kd=0.580581397359785)
    assert not certify(load_case("p3-c2"), unstable).is_certified


def test_plants_that_need_feedback_are_certified_too() -> None:
    integrator = Loop(TransferFunction((1.0,), (1.0, 0.0), 0.5), Gains("tdof_npid1", 1.0, 0.1, 0.2, 0.3), 0.01)
    unstable = Loop(TransferFunction((1.0,), (1.0, -1.0), 0.2), Gains("npid", 2.5, 0.5, 0.2), 0.01)
    reverse = Loop(TransferFunction((-2.0,), (1.0, 1.0), 0.2), Gains("npid", -0.5, -0.5, -0.05), 0.01)
    for loop in (integrator, unstable, reverse):
        found = certify(case_of(loop), loop.gains)
        assert found.is_certified and found.method == "circle"
        limited = loop.gains.with_values(effort_min=-9.0, effort_max=9.0, anti_windup="back_calculation")
        assert certify(case_of(loop), limited).is_certified == (loop is reverse)


def test_without_integral_action_the_linear_loop_decides() -> None:
    loop = Loop(TransferFunction((1.0,), (1.0, 1.0), 0.1), Gains("npid", 2.0), 0.01)
    found = certify(case_of(loop), loop.gains)
    assert (found.status, found.method, found.creep) == ("certified", "linear", None)
    assert "error remains" in " ".join(found.claim)
    limited = loop.gains.with_values(effort_max=0.5)
    assert certify(case_of(loop), limited).is_certified
    assert not certify(case_of(loop), loop.gains.with_values(kp=40.0)).is_certified


def test_a_linear_law_is_certified_by_its_modes_where_the_circle_fails() -> None:
    case = load_case("p2-c5")
    gains = Gains("pid", 5.724, 4.2, 14.208)
    assert margins(case, gains).stable
    found = certify(case, gains)
    assert (found.status, found.method) == ("certified", "linear")
    assert certify(case, gains.with_values(type="npid")).status == "not certified"


@pytest.mark.parametrize(
    ("options", "gains", "limits", "word"),
    [
        ({"dead_band": 0.1}, {}, None, "dead band"),
        ({"angle": True}, {}, None, "angles"),
        ({"setpoint_rate": 1.0}, {}, None, "setpoint_rate"),
        ({"effort_rate": 1.0}, {}, None, "effort_rate"),
        ({"manual": True}, {}, None, "manual"),
        ({}, {"integral_max": 1.0}, None, "limits of the integral action"),
        ({}, {"effort_max": 5.0}, None, "conditional integration"),
        ({}, {}, (0.0, 5.0), "which the controller does not know"),
        ({}, {"effort_min": 0.0, "effort_max": 9.0, "anti_windup": "back_calculation"}, (0.0, 5.0), "does not know"),
    ],
)
def test_what_is_not_covered_is_named(
    options: dict[str, object], gains: dict[str, object], limits: tuple[float, float] | None, word: str
) -> None:
    case = load_case("p1-c4")
    case = replace(case, options=ControllerOptions(**options))  # type: ignore[arg-type]
    case = replace(case, effort_limits=limits) if limits else case
    found = certify(case, case.gains.with_values(**gains))
    assert found.status == "not covered"
    assert word in " ".join(found.reasons)
    assert found.claim == ()


def test_the_filter_of_the_output_is_covered() -> None:
    case = replace(load_case("p1-c4"), options=ControllerOptions(filter_time=0.5))
    found, without = certify(case, case.gains), certify(load_case("p1-c4"), case.gains)
    assert found.is_certified
    assert found.delta is not None and without.delta is not None and found.delta < without.delta


def test_a_plant_that_is_not_linear_is_not_covered_but_has_margins() -> None:
    case = load_case("sprott")
    found = certify(case, case.gains)
    assert found.status == "not covered" and "not linear" in found.reasons[0]
    assert found.margins is not None and found.margins.m_s is not None


@pytest.mark.parametrize("size", [3.0, 3.5])
def test_the_creep_time_is_what_the_simulation_takes(size: float) -> None:
    case = load_case("p1-c4")
    gains = case.gains.with_values(type="npid", sigma=0.1)
    found = certify(case, gains)
    assert found.creep is not None and found.re_g_zero is not None
    tau, h = found.creep.time_constant_s, case.sample_period
    expected = creep_time(size * 0.1, 0.1, 0.1, tau, found.re_g_zero)
    begin = 0.1 * (size + 0.4)  # a little more, so that the first oscillation is over when it passes
    disturbance = begin * (1 + 1.528)  # K/(1 + K K_p) of it is left to the integral action
    steps = round((1.3 * creep_time(begin, 0.1, 0.1, tau, found.re_g_zero) + 50 * tau) / h)
    signals = SampledPlan(case.sample_period_ns, np.zeros(steps + 1), np.full(steps + 1, disturbance),
                          (Segment(0, steps, {}),))  # fmt: skip
    error = np.abs(closed_loop.simulate(case.plant_at, gains, signals, case.effort_limits).output[:, 0])
    passed, arrived = (int(np.flatnonzero(error > level)[-1]) for level in (size * 0.1, 0.1))
    assert (arrived - passed) * h == pytest.approx(expected, rel=0.04)


def test_a_faster_ramp_than_the_certificate_says_escapes() -> None:
    case = load_case("p1-c4")
    gains = case.gains.with_values(type="npid")
    creep = certify(case, gains).creep
    assert creep is not None and creep.setpoint_ramp is not None
    h, steps = case.sample_period, 200_000
    time = np.arange(steps + 1) * h
    for factor, follows in ((0.95, True), (1.05, False)):
        for ramp, name in ((creep.setpoint_ramp, "setpoint"), (creep.disturbance_ramp, "disturbance")):
            # Up to the ramp's rate slowly, which the integral action can follow to just below what it can do at most.
            rate = factor * ramp * np.minimum(1.0, time / (0.5 * time[-1]))
            signals = {"setpoint": np.zeros(steps + 1), "disturbance": np.zeros(steps + 1)}
            signals[name] = np.cumsum(rate) * h
            plan = SampledPlan(case.sample_period_ns, **signals, segments=(Segment(0, steps, {}),))
            run = closed_loop.simulate(case.plant_at, gains, plan, case.effort_limits)
            error = abs(run.setpoint[-1] - run.output[-1, 0])
            assert (error < 1.0) == follows, (factor, name, error)


def test_the_program_says_and_writes_what_is_claimed(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    page, picture = tmp_path / "c.html", tmp_path / "c.png"
    arguments = ["certify", "p2-c5", "--controller", "tdof_npid1"]
    assert main([*arguments, "--json", "--html", str(page), "--plot", str(picture)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert list(report) == ["case", "controller", "gains", "certificate"]
    assert report["certificate"]["status"] == "certified"
    assert report["certificate"]["method"] == "multiplier"
    text = page.read_text(encoding="utf-8")
    assert "What is not claimed" in text and "data:image/png" in text and "</html>" in text
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert main([*arguments, "--ki", "9"]) == 1
    assert "not certified" in capsys.readouterr().out
    assert main(["certify", "sprott", "--json", "--html", str(page)]) == 1
    assert json.loads(capsys.readouterr().out)["certificate"]["status"] == "not covered"


def test_numbers_that_are_infinite_are_null_in_json() -> None:
    loop = Loop(TransferFunction((1.0,), (1.0, 1.0)), Gains("npid", 0.0, 0.5), 0.01)
    json.dumps(certify(case_of(loop), loop.gains).as_dict(), allow_nan=False)
    far = load_case("p1-c4")
    creep = certify(far, far.gains.with_values(sigma=0.001)).creep
    assert creep is not None and creep.step_s is None  # a step of 1,000 sigma: beyond all numbers
    json.dumps(certify(far, far.gains.with_values(sigma=0.001)).as_dict(), allow_nan=False)
