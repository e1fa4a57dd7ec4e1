"""ROS parameters from the declarations in `dae_ros.config`: typed once, described, range-checked, no unknown keys."""

from __future__ import annotations

from typing import Any, Iterable, Mapping

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from dae_ros.config import ROBOT_SETTINGS, SETTINGS, SettingInfo, TeamKey, declarations, unknown_setting

KEY = {info.name: info for info in declarations(TeamKey)}
BUILT_IN = ('use_sim_time', 'start_type_description_service')


def declare(node: Node, declared: Iterable[SettingInfo]) -> dict[str, Any]:
    """Declares the settings as read-only parameters of `node`; their values by public name.

    `node` must have been created with `automatically_declare_parameters_from_overrides=True`: that is how overrides
    from the command line and parameter files are seen whole, so that a key nobody knows is an error that names it. A
    setting of another node's is fine, since one task file serves all nodes. Raises SettingsError.
    """
    declared = {info.name: info for info in declared}
    known = {**SETTINGS, **ROBOT_SETTINGS, **KEY, **declared}
    overrides = _take_overrides(node)
    for name in overrides:
        if name not in known:
            raise unknown_setting(name, known)
    values = {}
    for name, info in declared.items():
        values[name] = info.check(overrides.get(name, info.default))
        node.declare_parameter(name, values[name], _descriptor(info), ignore_override=True)
    for name, value in overrides.items():
        known[name].check(value)
    return values


def _take_overrides(node: Node) -> Mapping[str, Any]:
    """What the user set, by name; the parameters that stood for it are undeclared again."""
    names = [name for name in node.list_parameters([], 0).names
             if name not in BUILT_IN and not name.startswith('qos_overrides.')]
    overrides = {name: node.get_parameter(name).value for name in names}
    for name in names:
        node.undeclare_parameter(name)
    return overrides


def _descriptor(info: SettingInfo) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(description=info.describe(), read_only=True)
    if info.kind is int and info.minimum is not None:
        descriptor.integer_range = [IntegerRange(from_value=info.minimum, to_value=info.maximum)]
    elif info.kind is float and info.minimum is not None:
        descriptor.floating_point_range = [FloatingPointRange(from_value=info.minimum, to_value=info.maximum)]
    return descriptor
