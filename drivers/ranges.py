"""The ranges of quantities that people write in files: one table, of what UR arms, their tools and their tasks have.

A value outside was mostly written in another unit. Each range names its unit, for the message of a refused value.
"""

from typing import Annotated, Any

from pydantic import Field


def _range(unit: str, *, le: float, ge: float | None = None, gt: float | None = None) -> Any:
    return Field(ge=ge, gt=gt, le=le, json_schema_extra={"unit": unit})


# A full turn and a digit more, so that 6.2832 is one: UR joints turn by ± 360°.
LARGEST_ANGLE_RAD = 6.2832
LARGEST_MARGIN_RAD = 1.0
# ur-rtde refuses a faster command, which would end the worker (rtde_control_interface.h: UR_JOINT_VELOCITY_MAX and its
# neighbours). A stop brakes up to the hard limit of acceleration.
LARGEST_WRIST_SPEED_RAD_PER_S, _LARGEST_ANGULAR_ACCELERATION, _LARGEST_SPEED_M_PER_S = 3.14, 40.0, 3.0
# Of the largest UR arm.
LARGEST_PAYLOAD_KG = 35.0
# The torque on a tool that the skins and fingertips can bear.
LARGEST_TORQUE_NM = 5.0

Angle = Annotated[float, _range("rad", ge=-LARGEST_ANGLE_RAD, le=LARGEST_ANGLE_RAD)]
Turn = Annotated[float, _range("rad", gt=0, le=LARGEST_ANGLE_RAD)]
AngleMargin = Annotated[float, _range("rad", gt=0, le=LARGEST_MARGIN_RAD)]
# The largest UR arm reaches 1.75 m.
Coordinate = Annotated[float, _range("m", ge=-2, le=2)]
CoordinateMargin = Annotated[float, _range("m", gt=0, le=0.5)]
# From the flange to the tool's centre, or to the load's.
ToolLength = Annotated[float, _range("m", ge=-1, le=1)]
WristSpeed = Annotated[float, _range("rad/s", gt=0, le=LARGEST_WRIST_SPEED_RAD_PER_S)]
# A wrist 3 turns by up to 360° a second.
MeasuredWristSpeed = Annotated[float, _range("rad/s", gt=0, le=LARGEST_ANGLE_RAD)]
WristAcceleration = Annotated[float, _range("rad/s²", gt=0, le=_LARGEST_ANGULAR_ACCELERATION)]
Speed = Annotated[float, _range("m/s", gt=0, le=_LARGEST_SPEED_M_PER_S)]
MeasuredSpeed = Annotated[float, _range("m/s", gt=0, le=5)]
Acceleration = Annotated[float, _range("m/s²", gt=0, le=20)]
# The force and the torque at the tool's centre that the arm's own safety functions allow at most.
ToolForce = Annotated[float, _range("N", gt=0, le=250)]
ToolTorque = Annotated[float, _range("N·m", gt=0, le=60)]
Payload = Annotated[float, _range("kg", ge=0, le=LARGEST_PAYLOAD_KG)]
TorqueSetPoint = Annotated[float, _range("N·m", ge=-LARGEST_TORQUE_NM, le=LARGEST_TORQUE_NM)]
TorqueLimit = Annotated[float, _range("N·m", gt=0, le=LARGEST_TORQUE_NM)]
Seconds = Annotated[float, _range("s", ge=0, le=24 * 3600)]
Duration = Annotated[float, _range("s", gt=0, le=24 * 3600)]

Joints = tuple[Angle, Angle, Angle, Angle, Angle, Angle]
Position = tuple[Coordinate, Coordinate, Coordinate]
# Position in m and rotation vector in rad.
Pose = tuple[Coordinate, Coordinate, Coordinate, Angle, Angle, Angle]
ToolOffset = tuple[ToolLength, ToolLength, ToolLength, Angle, Angle, Angle]
ToolCentre = tuple[ToolLength, ToolLength, ToolLength]
