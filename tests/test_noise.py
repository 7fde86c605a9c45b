"""Noise of simulated plants: as told, the same in every way of running, and nothing where there is none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tdof_npid_ros import loop
from tdof_npid_ros.analysis.report import analyze
from tdof_npid_ros.analysis.verify import verify
from tdof_npid_ros.case import Case, load_case
from tdof_npid_ros.control.options import ControllerOptions
from tdof_npid_ros.plants.catalog import make_plant
from tdof_npid_ros.plants.kernels import standard_noise
from tdof_npid_ros.plants.linear import TransferFunction
from tdof_npid_ros.plants.plant import PlantError
from tdof_npid_ros.tuning.objective import Objective
from tdof_npid_ros.tuning.problem import TuningProblem

NOISE = {"noise": 0.02, "noise_seed": 7}


def noisy(name: str, **values: float) -> Case:
    case = load_case(name)
    return replace(case, plant_values={**case.plant_values, **(values or NOISE)})


def test_the_noise_is_nearly_normal_and_white() -> None:
    values = np.array([standard_noise(1.0, 5.0, float(k)) for k in range(50_000)])
    assert abs(values.mean()) < 0.02 and abs(values.std() - 1.0) < 0.02
    assert np.abs(values).max() < 6.0
    assert abs((values**4).mean() - 2.9) < 0.1
    for lag in (1, 2, 3, 7):
        assert abs(np.mean(values[lag:] * values[:-lag])) < 0.02


def mixed(z: int) -> int:
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
    z = (z ^ (z >> 27)) * 0x94D049BB133111EB % 2**64
    return z ^ (z >> 31)


def noise_in_whole_numbers(seed: int, episode: int, step: int) -> float:
    """As the documentation tells it, in Python's own whole numbers."""
    golden = 0x9E3779B97F4A7C15
    key = mixed(mixed((seed + golden) % 2**64) ^ episode)
    draws = [mixed((key + (3 * step + i) * golden) % 2**64) for i in (1, 2, 3)]
    return (sum((draw >> shift) & 0xFFFF for draw in draws for shift in (0, 16, 32, 48)) - 12 * 32767.5) / 65536


def test_the_noise_has_the_same_bits_everywhere() -> None:
    for seed, episode in ((0, 0), (7, 0x9002EFE4783F), (2**31 - 1, 2**48 - 1)):
        for step in (0, 1, 2, 1000, 10**9):
            told = standard_noise(float(seed), float(episode), float(step))
            assert told == noise_in_whole_numbers(seed, episode, step)


@pytest.mark.parametrize("name", ["p1-c0.5", "p3-c1", "sprott"])
def test_the_compiled_loop_and_the_nodes_classes_have_the_same_noise(name: str) -> None:
    case = noisy(name, noise=0.02, quantum=0.005, noise_seed=3)
    compiled = case.simulate("setpoint")
    stepped = loop.simulate_operated(
        case.plant_at, case.gains, ControllerOptions(), case.signals["setpoint"], case.effort_limits
    )
    assert compiled.output.tobytes() == stepped.output.tobytes()
    assert compiled.control_effort.tobytes() == stepped.control_effort.tobytes()
    lanes = case.simulate("setpoint", case.gains.with_values(kp=(float(case.gains.per_lane("kp")[0]),) * 19))
    assert (lanes.output == compiled.output).all()
    quanta = compiled.output / 0.005
    assert np.allclose(quanta, np.round(quanta), rtol=0, atol=1e-9)


def test_an_episode_has_noise_of_its_own_and_the_same_each_time() -> None:
    case = noisy("p1-c0.5")
    first, again = case.simulate("setpoint"), case.simulate("setpoint")
    assert first.output.tobytes() == again.output.tobytes()
    quiet = load_case("p1-c0.5")
    noise = {name: case.simulate(name).output[:90, 0] - quiet.simulate(name).output[:90, 0] for name in case.episodes}
    assert abs(np.corrcoef(noise["setpoint"], noise["disturbance"])[0, 1]) < 0.3
    other = noisy("p1-c0.5", noise=0.02, noise_seed=8).simulate("setpoint").output[:90, 0]
    assert abs(np.corrcoef(other, first.output[:90, 0])[0, 1]) < 0.3
    assert 0.015 < noise["setpoint"].std() < 0.025  # within the dead time


def test_without_noise_the_plant_is_as_it_was() -> None:
    plant = make_plant("first_order", {"noise": 0.0, "quantum": 0.0, "noise_seed": 5})
    assert isinstance(plant, TransferFunction)


@pytest.mark.parametrize(("name", "value"), [("noise", -0.1), ("quantum", float("nan")), ("noise_seed", -1)])
def test_what_no_noise_can_be_is_refused(name: str, value: float) -> None:
    with pytest.raises(PlantError, match=name):
        make_plant("first_order", {name: value})


def test_episodes_that_begin_at_rest_do_so_with_noise() -> None:
    case = replace(noisy("p1-c0.5"), episodes={"short": ("0 start 3", "1 setpoint 3.5", "4 end")})
    compiled = case.simulate("short")
    stepped = loop.simulate_operated(
        case.plant_at, case.gains, ControllerOptions(), case.signals["short"], case.effort_limits
    )
    assert compiled.output.tobytes() == stepped.output.tobytes()
    assert abs(compiled.output[0, 0] - 3.0) < 0.12 and compiled.output[0, 0] != 3.0


def test_a_tuner_judges_gains_in_noise_as_without() -> None:
    """The error that noise leaves at an episode's end is no tail that could matter."""
    quiet, case = load_case("p1-c0.5"), noisy("p1-c0.5", noise=0.005, noise_seed=1)
    candidates = np.array([[4.0, 1.2, 0.1], [30.0, 1.2, 0.1], [0.5, 0.01, 0.0]])  # good, unstable, too slow
    expected, found = (Objective(TuningProblem(one, "pid"))(candidates) for one in (quiet, case))
    assert (found.violation > 0).tolist() == (expected.violation > 0).tolist() == [False, True, True]
    again = Objective(TuningProblem(case, "pid"), threads=1)(candidates[::-1].copy())
    assert np.array_equal(again.objective[::-1], found.objective)


def test_a_bag_with_noise_is_verified_and_compared_with_the_simulation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parent / "analysis"))
    from loop_bags import LoopBag

    case = replace(noisy("p1-c0.5"), episodes={"setpoint": ("0 setpoint 1", "2 end")})
    with LoopBag(tmp_path / "bag") as bag:
        bag.configuration(case, case.gains)
        bag.episode(case, case.gains, "setpoint", 1)
    assert verify(tmp_path / "bag").different == 0
    (report,) = analyze([str(tmp_path / "bag")]).episodes
    assert report.deviation.output == report.deviation.control_effort == 0.0
