"""Plants are discretised exactly, and users bring their own."""

import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from tdof_npid_ros.case import load_case
from tdof_npid_ros.loop import simulate
from tdof_npid_ros.plants.catalog import make_plant, model_parameters, named_model
from tdof_npid_ros.plants.plant import Plant, PlantError
from tdof_npid_ros.plants.simulator import PlantSimulator
from tdof_npid_ros.scenario import Segment

UNLIMITED = (-math.inf, math.inf)


class Pendulum:
    """A user's plant: a damped pendulum with a torque at its pivot."""

    parameters = {"damping": 0.1, "stiffness": 9.81}  # noqa: RUF012 (as a user writes it)
    initial_state = (0.5, 0.0)

    @staticmethod
    def derivative(x, u, d, p):  # type: ignore[no-untyped-def]
        return (x[1], u + d - p[0] * x[1] - p[1] * math.sin(x[0]))

    @staticmethod
    def output(x, p):  # type: ignore[no-untyped-def]
        return x[0]


class NotTuple(Pendulum):
    @staticmethod
    def derivative(x, u, d, p):  # type: ignore[no-untyped-def]
        return x[1]


def response(plant: Plant, efforts: np.ndarray, period: float) -> np.ndarray:
    simulator = PlantSimulator(plant, round(period * 1e9), 1, UNLIMITED)
    outputs = [simulator.output[0]]
    for u in efforts:
        simulator.advance(np.array([u]), np.zeros(1))
        outputs.append(simulator.output[0])
    return np.array(outputs)


@pytest.mark.parametrize(
    ("model", "values", "transfer_function"),
    [
        ("first_order", {"time_constant": 5.0, "dead_time": 0.0}, ([1.0], [5.0, 1.0])),
        ("second_order", {"time_constant": 2.0, "dead_time": 0.0}, ([1.0], [4.0, 4.0, 1.0])),
        ("third_order", {"zero_time_constant": 2.0}, ([-2.0, 1.0], [1.0, 3.0, 3.0, 1.0])),
        ("transfer_function", {"numerator": [1.0, 2.0], "denominator": [2.0, 0.3, 5.0]}, ([1.0, 2.0], [2.0, 0.3, 5.0])),
    ],
)
def test_linear_plants_agree_with_scipys_discretisation(
    model: str, values: dict[str, object], transfer_function
) -> None:  # type: ignore[no-untyped-def]
    u = np.random.default_rng(3).normal(size=300)
    ours = response(make_plant(model, values), u, 0.1)[:-1]
    b, a, _ = signal.cont2discrete(transfer_function, 0.1, method="zoh")
    theirs = signal.lfilter(np.ravel(b), a, u)
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-11)


@pytest.mark.parametrize("dead_time", [0.0, 0.03, 0.1, 0.25, 0.3333, 1.0])
def test_dead_time_is_exact_also_between_samples(dead_time: float) -> None:
    """The step response of a delayed first-order lag, known in closed form."""
    period, lag = 0.1, 0.7
    y = response(make_plant("first_order", {"time_constant": lag, "dead_time": dead_time}), np.ones(40), period)
    t = np.maximum(np.arange(41) * period - dead_time, 0.0)
    np.testing.assert_allclose(y, 1.0 - np.exp(-t / lag), rtol=0, atol=1e-14)


def test_parameters_that_change_do_not_make_the_output_jump() -> None:
    simulator = PlantSimulator(make_plant("second_order", {}), 10_000_000, 1, UNLIMITED)
    for _ in range(200):
        simulator.advance(np.ones(1), np.zeros(1))
    before = simulator.output[0]
    simulator.change_plant(make_plant("second_order", {"time_constant": 3.0}))
    simulator.advance(np.ones(1), np.zeros(1))
    assert abs(simulator.output[0] - before) < 0.01


def test_sprott_circuit_follows_an_independent_solver_until_chaos_parts_them() -> None:
    from scipy.integrate import solve_ivp

    start = (-1.0, -2.0, 1.0)
    y = response(make_plant("sprott", {"initial_state": list(start)}), np.zeros(2000), 0.001)

    def slope(t: float, x: np.ndarray) -> list[float]:
        return [x[1], x[2], -1.2 * x[0] - x[1] - 0.6 * x[2] + 2 * np.sign(x[0])]

    theirs = solve_ivp(slope, (0, 2), start, rtol=1e-11, atol=1e-12, max_step=0.001, t_eval=[2.0]).y[0, -1]
    assert y[-1] == pytest.approx(theirs, abs=1e-3)


def test_a_users_plant_is_integrated_with_fourth_order_accuracy() -> None:
    from scipy.integrate import solve_ivp

    path, times = f"{__name__}:Pendulum", np.linspace(0, 1, 11)
    exact = solve_ivp(
        lambda t, x: Pendulum.derivative(x, 0.0, 0.0, (0.1, 9.81)), (0, 1), (0.5, 0.0),
        method="DOP853", rtol=1e-13, atol=1e-14, t_eval=times,
    ).y[0]  # fmt: skip
    errors = [
        np.max(np.abs(response(make_plant(named_model(path), {"substeps": substeps}), np.zeros(10), 0.1) - exact))
        for substeps in (1, 2, 4)
    ]
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.3)
    assert errors[1] / errors[2] == pytest.approx(16, rel=0.3)


def test_a_users_plant_leaves_nothing_in_the_cache_that_others_cannot_read(tmp_path: Path) -> None:
    """A cached function that names a user's class could not be loaded where that class is not importable."""
    plants, program = (
        tmp_path / "my_plants.py",
        "from tdof_npid_ros.case import load_case; load_case({!r}).simulate('run')",
    )
    plants.write_text(
        "class Lag:\n    parameters = {'rate': 1.0}\n    initial_state = (0.0,)\n"
        "    @staticmethod\n    def derivative(x, u, d, p):\n        return (p[0] * (u + d - x[0]),)\n"
        "    @staticmethod\n    def output(x, p):\n        return x[0]\n"
    )
    case = tmp_path / "lag.yaml"
    case.write_text(
        "/**/plant: {ros__parameters: {model: 'my_plants:Lag'}}\n"
        "/**/scenario: {ros__parameters: {episodes: [run], plan: {run: ['0 setpoint 1', '1 end']}}}\n"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONWARNINGS": "error"}
    for name, path in ((str(case), str(tmp_path)), ("p1-c4", "")):
        done = subprocess.run(
            [sys.executable, "-c", program.format(name).replace("'run'", "'run'" if path else "'setpoint'")],
            env={**environment, "PYTHONPATH": path}, capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr


def test_lanes_of_a_users_plant_are_independent() -> None:
    simulator = PlantSimulator(make_plant(named_model(f"{__name__}:Pendulum"), {}), 10_000_000, 3, UNLIMITED)
    for _ in range(50):
        simulator.advance(np.array([0.0, 1.0, 2.0]), np.zeros(3))
    assert len(set(simulator.output)) == 3


def test_a_lane_that_diverges_stays_finite() -> None:
    simulator = PlantSimulator(make_plant("transfer_function", {"denominator": [1.0, -50.0]}), 10_000_000, 1, UNLIMITED)
    for _ in range(3000):
        simulator.advance(np.ones(1), np.zeros(1))
    assert math.isfinite(simulator.output[0])


def test_the_plants_own_limits_are_applied_and_reported() -> None:
    simulator = PlantSimulator(make_plant("first_order", {}), 10_000_000, 1, (-1.0, 0.5))
    simulator.advance(np.array([3.0]), np.zeros(1))
    assert simulator.applied_effort[0] == 0.5


@pytest.mark.parametrize(
    ("model", "values", "word"),
    [
        ("no_such", {}, "no_such"),
        ("first_order", {"time_constant": 0.0}, "time_constant"),
        ("first_order", {"dead_time": -1.0}, "dead_time"),
        ("first_order", {"gain": math.nan}, "gain"),
        ("first_order", {"gain": "much"}, "gain"),
        ("transfer_function", {"numerator": [1.0, 0.0], "denominator": [1.0, 1.0]}, "strictly proper"),
        ("transfer_function", {"denominator": [0.0]}, "denominator"),
        ("transfer_function", {"denominator": [1.0] * 51}, "degree 50: it must be 20 or less"),
        ("sprott", {"initial_state": [0.0]}, "initial_state"),
        ("no.such.module:Plant", {}, "no.such.module"),
        ("tests.test_plants:missing", {}, "missing"),
        ("math:pi", {}, "not a plant class"),
        (f"{__name__}:NotTuple", {}, "tuple"),
    ],
)
def test_plants_that_cannot_be_built_are_refused_with_the_reason(
    model: str, values: dict[str, object], word: str
) -> None:
    with pytest.raises(PlantError, match=word):
        make_plant(named_model(model), values)


USERS_PLANT = """
import math

class Tank:
    parameters = {"area": 2.0}
    initial_state = (0.0,)

    @staticmethod
    def derivative(x, u, d, p):
        return ((u + d) / p[0] - math.sqrt(abs(x[0])),)

    @staticmethod
    def output(x, p):
        return x[0]
"""


def users_plant(name: str, text: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (folder / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(folder)
    return f"{name}:Tank"


def test_a_users_plant_has_its_parameters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plant = make_plant(
        named_model(users_plant("good_tank", USERS_PLANT, tmp_path, monkeypatch)), {"area": 4.0, "substeps": 3}
    )
    sampled = plant.sampled(10_000_000)
    assert (sampled.parameters, sampled.substeps) == ((4.0,), 3)


@pytest.mark.parametrize(
    ("name", "right", "wrong", "words"),
    [
        ("syntax", "class Tank:", "class Tank(:", "SyntaxError"),
        ("start", "import math", "import math; no_such_name", "NameError"),
        ("undefined", "math.sqrt(abs(x[0]))", "no_such_name", "no_such_name"),
        ("state", "return x[0]", "return x[7]", r"out of range.*state_tank.py"),
        (
            "shape",
            ",)\n\n    @staticmethod\n    def output",
            ", 0.0)\n\n    @staticmethod\n    def output",
            "tuple of 1",
        ),
        ("method", "    @staticmethod\n    def output(x, p)", "    def output(self, x, p)", "static methods"),
        ("parameters", '{"area": 2.0}', "[2.0]", "map names to finite numbers"),
        ("value", '{"area": 2.0}', '{"area": "wide"}', "map names to finite numbers"),
        ("initial", "(0.0,)", "0.0", "initial_state"),
        ("infinite", "return x[0]", "return x[0] / 0.0", "must be finite"),
    ],
)
def test_a_users_plant_that_cannot_run_is_refused_with_the_reason(
    name: str, right: str, wrong: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert right in USERS_PLANT
    model = users_plant(f"{name}_tank", USERS_PLANT.replace(right, wrong, 1), tmp_path, monkeypatch)
    with pytest.raises(PlantError, match=words) as caught:
        make_plant(named_model(model), {})
    assert "\n" not in str(caught.value)


def test_a_users_class_lies_on_the_path_or_in_the_folder_of_the_file_that_names_it(tmp_path: Path) -> None:
    """As in docs/your-own-plant.md: a package beside the parameter file, and a program that is started elsewhere."""
    (tmp_path / "tanks").mkdir()
    (tmp_path / "tanks" / "folder_tank.py").write_text(USERS_PLANT)
    file = tmp_path / "tank.yaml"
    file.write_text("/**/plant: {ros__parameters: {model: 'tanks.folder_tank:Tank'}}")
    before = list(sys.path)
    assert load_case(file).model == "tanks.folder_tank:Tank"
    assert sys.path == before
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "tank.yaml").write_text("/**/plant: {ros__parameters: {model: 'other_tank:Tank'}}")
    with pytest.raises(PlantError, match="in the parameter file's folder"):
        load_case(tmp_path / "other" / "tank.yaml")


def test_two_modules_of_one_name_are_not_mistaken_for_each_other(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "twin_tank.py").write_text(USERS_PLANT)
        (tmp_path / name / "tank.yaml").write_text("/**/plant: {ros__parameters: {model: 'twin_tank:Tank'}}")
    load_case(tmp_path / "one" / "tank.yaml")
    load_case(tmp_path / "one" / "tank.yaml")
    with pytest.raises(PlantError, match="another module twin_tank is loaded already"):
        load_case(tmp_path / "two" / "tank.yaml")


def test_a_class_that_the_user_has_not_named_is_never_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "evil_tank.py").write_text(f"open({str(tmp_path / 'executed')!r}, 'w')\n{USERS_PLANT}")
    monkeypatch.syspath_prepend(tmp_path)
    for use in (make_plant, lambda model, _: model_parameters(model)):
        with pytest.raises(PlantError, match="--case FILE"):
            use("evil_tank:Tank", {})
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize("substeps", [0, 1.5])
def test_substeps_are_a_whole_number(substeps: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = users_plant(f"sub_tank_{int(substeps)}", USERS_PLANT, tmp_path, monkeypatch)
    with pytest.raises(PlantError, match="whole number"):
        make_plant(named_model(model), {"substeps": substeps})


@pytest.mark.parametrize("dead_time", [0.0, 0.49, 500.0])
def test_the_dead_time_of_a_plant_that_runs_does_not_change(dead_time: float) -> None:
    """The efforts on their way have their place: compiled code must not look for more of them."""
    case = load_case("p1-c0.5")
    simulator = PlantSimulator(case.plant, case.sample_period_ns, 1, (-math.inf, math.inf))
    with pytest.raises(PlantError, match="dead_time cannot change"):
        simulator.change_plant(case.plant_at({"dead_time": dead_time}))
    signals = replace(
        case.signals["setpoint"], segments=(Segment(0, 10, {}), Segment(10, 99, {"dead_time": dead_time}))
    )
    with pytest.raises(PlantError, match="dead_time cannot change"):
        simulate(case.plant_at, case.gains, signals, case.effort_limits)
    simulator.change_plant(case.plant_at({"gain": 2.0, "dead_time": 0.5}))


def test_numbers_beyond_all_bounds_are_refused() -> None:
    for values in ({"time_constant": 1e110}, {"dead_time": 1e300}):
        with pytest.raises(PlantError):
            make_plant("third_order", values).sampled(10_000_000)
