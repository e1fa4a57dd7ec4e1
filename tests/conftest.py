"""Puts the tests' process into the surroundings the nodes run in: one thread for each numerical library."""

import dae_ros_nodes  # noqa: F401  sets the variables; before numpy and torch are imported
