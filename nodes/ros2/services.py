"""Services of std_srvs as rmw_cyclonedds has them on the wire, field by field.

Who asked and which of its requests it was (`cdds_request_header` there) stand before the fields of the .srv file, in
the request and, copied, in the reply. A request without fields has one byte that stands for them, as in all of ROS 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Protocol

from nodes.ros2.messages import Bool, UInt8

UInt64 = Annotated[int, "u8"]
Int64 = Annotated[int, "i8"]


@dataclass(frozen=True)
class TriggerRequest:
    guid: UInt64  # of the client, which knows its replies by it
    seq: Int64
    structure_needs_at_least_one_member: UInt8 = 0

    ros: ClassVar[str] = "std_srvs/srv/Trigger_Request"


@dataclass(frozen=True)
class TriggerResponse:
    guid: UInt64
    seq: Int64
    success: Bool
    message: str

    ros: ClassVar[str] = "std_srvs/srv/Trigger_Response"


@dataclass(frozen=True)
class SetBoolRequest:
    guid: UInt64
    seq: Int64
    data: Bool

    ros: ClassVar[str] = "std_srvs/srv/SetBool_Request"


@dataclass(frozen=True)
class SetBoolResponse:
    guid: UInt64
    seq: Int64
    success: Bool
    message: str

    ros: ClassVar[str] = "std_srvs/srv/SetBool_Response"


class ServiceMessage(Protocol):
    ros: ClassVar[str]

    @property
    def guid(self) -> int: ...

    @property
    def seq(self) -> int: ...


@dataclass(frozen=True)
class ServiceType:
    request: Any
    response: Any


TRIGGER = ServiceType(TriggerRequest, TriggerResponse)
SET_BOOL = ServiceType(SetBoolRequest, SetBoolResponse)
