"""The ROS 2 graph: nodes that wire parameters, topics, services and timers to the layers below."""
