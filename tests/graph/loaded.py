"""What every node needs, loaded and compiled: the server of `forked` imports this before it forks any node."""

import tdof_npid_ros.graph.controller_node
import tdof_npid_ros.graph.plant.node
import tdof_npid_ros.graph.recorder.node
import tdof_npid_ros.graph.replay_node
import tdof_npid_ros.graph.scenario_node
import tdof_npid_ros.graph.tuner.node  # noqa: F401
from tdof_npid_ros.control.controller import Controller
from tdof_npid_ros.control.gains import Gains
from tdof_npid_ros.control.options import ControllerOptions
from tdof_npid_ros.plants.linear import TransferFunction
from tdof_npid_ros.plants.simulator import PlantSimulator

PERIOD_NS = 10_000_000

Controller(Gains(), PERIOD_NS, ControllerOptions()).warm_up()
PlantSimulator(TransferFunction((1.0,), (1.0, 1.0)), PERIOD_NS, 1, (-1.0, 1.0)).warm_up()
