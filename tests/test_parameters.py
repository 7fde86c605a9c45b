"""The tables of parameters: every entry by its own rule, and what is made of them without ROS."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest

from tdof_npid_ros.bag.file_writer import COMPRESSIONS
from tdof_npid_ros.control.controller import parameters_digest
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.control.options import PLAIN, ControllerOptions
from tdof_npid_ros.parameter import ABOVE_0, ABOVE_0_FINITE, FINITE, FROM_0, Parameter, ParameterError, Range
from tdof_npid_ros.parameters import GAINS, MODELS, NODES, OPTIONS, RECORDER, TUNER, misspelt, sample_period_in_ns
from tdof_npid_ros.plants.catalog import changeable_parameters, make_plant, model_table, named_model
from tdof_npid_ros.plants.plant import PlantError
from tdof_npid_ros.tuning.optimizers import ALGORITHMS

EVERY = [(table, name) for table, its in (*NODES.items(), *MODELS.items()) for name in its]


@pytest.mark.parametrize(("table", "name"), EVERY)
def test_a_default_is_what_its_own_rule_allows(table: str, name: str) -> None:
    parameter = (NODES.get(table) or MODELS[table])[name]
    like = parameter.example if parameter.default is None else parameter.default
    assert parameter.checked(like) == like
    assert parameter.name == name
    assert parameter.description
    assert parameter.default is not None or parameter.otherwise


def test_the_choices_are_those_that_the_program_has() -> None:
    assert set(RECORDER["compression"].choices) == set(COMPRESSIONS)
    assert set(TUNER["algorithm"].choices) == set(ALGORITHMS)


def test_gains_and_options_are_their_tables() -> None:
    assert Gains().as_dict() == {name: parameter.default for name, parameter in GAINS.items()}
    assert PLAIN.as_dict() == {name: parameter.default for name, parameter in OPTIONS.items()}
    assert list(Gains().as_dict()) == list(GAINS)


def parameter(default: Any, **rule: Any) -> Parameter:
    return Parameter("p", default, "", **rule)


INTERVAL = parameter([0.0, 1.0], within=FINITE, length=2, is_interval=True)
TEXT = "text, in quotes if it looks like a number"


@pytest.mark.parametrize(
    ("its", "good", "bad", "wanted"),
    [
        (
            parameter(1.0, unit="s", within=Range(0.0, 9.0)),
            [0, np.float32(2)],
            [-1, 9.5],
            "a number from 0 to 9, in s",
        ),
        (parameter(1.0, within=ABOVE_0), [1e-300, math.inf], [0.0, -1.0], "a number above 0"),
        (parameter(1.0, within=ABOVE_0_FINITE), [5], [0.0, math.inf], "a number above 0, finite"),
        (parameter(1.0, within=FROM_0), [0, 5], [-0.5, math.inf], "a number not below 0, finite"),
        (parameter(1.0, within=FINITE), [-5.0], [math.inf, -math.inf], "a finite number"),
        (parameter(1.0), [math.inf, -3], ["1", None, True, 10**400, [1.0], {}], "a number"),
        (parameter(1.0, per_lane=True), [2, [1.0, 2]], [[], ["x"], "ab"], "a number, or a list of such, one per lane"),
        (parameter(1.0, is_whole=True), [2.0, 3], [2.5, math.inf], "a whole number"),
        (parameter(1, within=Range(0, 9)), [0, np.int64(9)], [1.0, True, 10], "a whole number from 0 to 9"),
        (parameter(True), [False], [0, "true", None], "true or false"),
        (parameter("a", choices=("a", "")), ["a", ""], ["b", 1, ["a"]], "one of a, ''"),
        (parameter([""]), [[], ["x", "y"], ("x",)], ["x", [1], None], f"a list, each of it {TEXT}"),
        (parameter([1.0, 2.0], length=2), [[1, 2]], [[1.0], [1.0, 2.0, 3.0]], "a list of 2, each of it a number"),
        (INTERVAL, [[-1, 1]], [[1.0, 1.0], [0.0, math.inf]], "[lower, upper] with lower < upper, both finite"),
        (parameter(None, example=1.0, otherwise="x"), [3], ["x"], "a number"),
    ],
)
def test_values_are_checked(its: Parameter, good: list[Any], bad: list[Any], wanted: str) -> None:
    for value in good:
        taken = its.checked(value)
        assert np.all(np.asarray(taken) == np.asarray(value))
        assert all(type(one) is its.kind for one in (taken if isinstance(taken, list) else [taken]))
    for value in [*bad, math.nan]:
        with pytest.raises(ParameterError) as told:
            its.checked(value)
        assert str(told.value).startswith("p is ") and str(told.value).endswith(f": it must be {wanted}")
        assert len(str(told.value)) < 300


def test_a_value_of_any_length_makes_a_short_message() -> None:
    for value in ("x\n" * 100_000, [0.5] * 100_000, 10**5000):
        with pytest.raises(ParameterError) as told:
            parameter(1, within=Range(0, 9)).checked(value)
        assert len(str(told.value)) < 300 and "\n" not in str(told.value)


def test_misspelt_names_are_found() -> None:
    given = [
        "kp",
        "kpp",
        "sample_period",
        "lanes",
        "use_sim_time",
        "plan.x",
        "qos_overrides./output.depth",
        "quite else",
    ]
    nothing = "is not one of this node's, and does nothing"
    assert misspelt(given, NODES["controller"]) == [
        f"parameter kpp {nothing}: kp is meant?",
        f"parameter quite else {nothing}",
    ]


@pytest.mark.parametrize("period", [1e-10, 1.5e-9, 1e10, 1e305, 1e400, "0.01", [0.01]])
def test_a_sample_period_is_a_whole_number_of_nanoseconds(period: object) -> None:
    assert sample_period_in_ns(0.005) == 5_000_000
    with pytest.raises(ParameterError, match="sample_period is "):
        sample_period_in_ns(period)


# Digests


@dataclass(frozen=True)
class _LaterOptions(ControllerOptions):
    unwinds: bool = False

    def __post_init__(self) -> None:
        pass


def test_digests_of_recorded_bags_are_found_for_ever() -> None:
    assert parameters_digest(Gains(), 10_000_000) == "fadb02299d2d"
    gains, options = Gains("pid", kp=(1.0, 2.0), ki=3), ControllerOptions(dead_band=0.1, manual_effort=(1, 2))
    assert parameters_digest(gains, 5_000_000, options) == "a3616d3cef07"


def test_an_option_that_comes_later_changes_no_digest_until_it_is_used() -> None:
    assert parameters_digest(Gains(), 10_000_000, _LaterOptions()) == "fadb02299d2d"
    assert parameters_digest(Gains(), 10_000_000, _LaterOptions(unwinds=True)) != "fadb02299d2d"


# Plants of users


class Tank:
    parameters: ClassVar = {"area": 2.0, "outlet": 0.1}
    descriptions: ClassVar = {"area": "cross-section, m²"}
    ranges: ClassVar = {"area": (0.0, math.inf), "outlet": (0.05, 1.0)}
    initial_state = (1.0,)

    @staticmethod
    def derivative(x, u, d, p):  # type: ignore[no-untyped-def]
        return ((u + d - p[1] * x[0]) / p[0],)

    @staticmethod
    def output(x, p):  # type: ignore[no-untyped-def]
        return x[0]


MODEL = f"{__name__}:Tank"


def test_a_class_brings_its_parameters_with_descriptions_and_ranges() -> None:
    table = model_table(named_model(MODEL))
    assert list(table) == ["area", "outlet", "initial_state", "substeps"]
    assert table["area"].description == "cross-section, m²"
    assert table["area"].wanted == "a number not below 0, finite, or a list of such, one per lane"
    assert table["outlet"].is_slider and not table["area"].is_slider
    assert changeable_parameters(MODEL) == ["area", "outlet"]
    with pytest.raises(PlantError, match=r"outlet is 0.01: it must be a number from 0.05 to 1"):
        make_plant(MODEL, {"outlet": 0.01})


@pytest.mark.parametrize(
    ("attribute", "value", "words"),
    [
        ("descriptions", {"aera": "x"}, "descriptions is {'aera': 'x'}: it must map names of parameters"),
        ("ranges", {"area": 5}, "ranges['area'] is 5: it must be (lower, upper)"),
        ("ranges", {"area": (3.0, 4.0)}, "area is 2.0: it must be a number from 3 to 4"),
    ],
)
def test_a_class_whose_parameters_contradict_each_other_is_refused(
    monkeypatch: pytest.MonkeyPatch, attribute: str, value: object, words: str
) -> None:
    monkeypatch.setattr(Tank, attribute, value)
    with pytest.raises(PlantError) as told:
        named_model(MODEL)
    assert words in str(told.value)
