"""RTDE variables and registers: names, types and how their values look on the wire (UR's RTDE guide, "field names")."""

import struct
from collections.abc import Iterable, Sequence

FORMATS = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
}
REGISTERS = 48

Value = int | float | Sequence[float]

_BY_TYPE = {
    "DOUBLE": "timestamp actual_execution_time speed_scaling target_speed_fraction speed_scaling_combined "
    "actual_momentum actual_main_voltage actual_robot_voltage actual_robot_current payload "
    "standard_analog_input0 standard_analog_input1 standard_analog_output0 standard_analog_output1 "
    "standard_analog_input_0 standard_analog_input_1 standard_analog_output_0 standard_analog_output_1 "
    "speed_slider_fraction",
    "VECTOR6D": "target_q target_qd target_qdd target_current target_moment actual_q actual_qd actual_current "
    "joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force target_TCP_pose target_TCP_speed "
    "joint_temperatures actual_joint_voltage ft_raw_wrench payload_inertia actual_current_as_torque "
    "external_force_torque",
    "VECTOR3D": "actual_tool_accelerometer payload_cog",
    "VECTOR6INT32": "joint_mode",
    "UINT64": "actual_digital_input_bits actual_digital_output_bits",
    "UINT32": "robot_status_bits safety_status_bits runtime_state speed_slider_mask",
    "INT32": "robot_mode safety_mode safety_status",
}
TYPES = {name: kind for kind, names in _BY_TYPE.items() for name in names.split()}
for _direction in ("input", "output"):
    for _number in range(REGISTERS):
        TYPES[f"{_direction}_int_register_{_number}"] = "INT32"
        TYPES[f"{_direction}_double_register_{_number}"] = "DOUBLE"

# Before 5.9 there is no raw wrench, before 5.23 no current as torque; a client that asks is told NOT_FOUND.
SINCE = {"ft_raw_wrench": (5, 9), "actual_current_as_torque": (5, 23), "external_force_torque": (5, 4)}


def known_type(name: str, version: tuple[int, ...]) -> str | None:
    """Return the RTDE type of a variable, or None where a controller of this version does not have it."""
    if version[:2] < SINCE.get(name, (0, 0)):
        return None
    return TYPES.get(name)


def pack(kinds: Iterable[str], values: Iterable[Value]) -> bytes:
    """Return values one after the other, big-endian and without padding."""
    flat: list[int | float] = []
    kinds = list(kinds)
    for value in values:
        if isinstance(value, int | float):
            flat.append(value)
        else:
            flat.extend(value)
    return struct.pack(">" + "".join(FORMATS[kind] for kind in kinds), *flat)


def unpack(kinds: Iterable[str], data: bytes) -> list[float] | None:
    """Return the scalar values of an input package, or None when its length is not the recipe's."""
    layout = ">" + "".join(FORMATS[kind] for kind in kinds)
    if struct.calcsize(layout) != len(data):
        return None
    return list(struct.unpack(layout, data))
