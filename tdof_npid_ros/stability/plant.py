"""The plant of a case as the margins see it: linear, with the controller's filter behind it."""

from __future__ import annotations

from tdof_npid_ros.case import Case
from tdof_npid_ros.plants.kernels import SampledLinear
from tdof_npid_ros.stability import StabilityError
from tdof_npid_ros.stability.pulse import PulseTransfer, pulse_transfer


def loop_plant(case: Case) -> PulseTransfer:
    """From the controller's effort to the output that its law is given, sampled as the loop is.

    Raises:
        StabilityError: the plant is not linear.

    Example:
        plant = loop_plant(load_case("p1-c4"))
    """
    sampled = case.plant.sampled(case.sample_period_ns)
    if not isinstance(sampled, SampledLinear):
        raise StabilityError(f"{case.name}: the plant {case.model} is not linear")
    return pulse_transfer(sampled, case.sample_period).filtered(case.options.filter_time)
