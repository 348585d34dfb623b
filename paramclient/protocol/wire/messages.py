"""The message classes of this library, and the MAVLink constants in their fields."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple, TypeAlias

from paramclient.protocol.wire.signing import SigningKey

__all__ = [
    "AUTOPILOT_COMPONENT",
    "AUTOPILOT_VERSION_ID",
    "AutopilotVersion",
    "CAPABILITY_FTP",
    "CAPABILITY_PARAM_ENCODE_BYTEWISE",
    "CAPABILITY_PARAM_ENCODE_C_CAST",
    "COMPONENT_METADATA_ID",
    "COMP_ID_ALL",
    "COMP_ID_MISSIONPLANNER",
    "CommandAck",
    "CommandLong",
    "ComponentMetadata",
    "FileTransfer",
    "HASH_CHECK",
    "HEARTBEAT_ID",
    "Heartbeat",
    "HighLatency2",
    "MAV_AUTOPILOT_ARDUPILOTMEGA",
    "MAV_AUTOPILOT_GENERIC",
    "MAV_AUTOPILOT_INVALID",
    "MAV_AUTOPILOT_PX4",
    "MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN",
    "MAV_CMD_PREFLIGHT_STORAGE",
    "MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES",
    "MAV_CMD_REQUEST_MESSAGE",
    "MAV_MODE_FLAG_SAFETY_ARMED",
    "MAV_RESULT_ACCEPTED",
    "MAV_RESULT_DENIED",
    "MAV_RESULT_FAILED",
    "MAV_RESULT_UNSUPPORTED",
    "MAV_STATE_ACTIVE",
    "MAV_STATE_BOOT",
    "MAV_TYPE_GCS",
    "MAV_TYPE_GENERIC",
    "PARAMETERS_MAX",
    "Message",
    "NO_INDEX",
    "PARAM_EXT_VALUE_ID",
    "PARAM_VALUE_ID",
    "ParamError",
    "ParamExtAck",
    "ParamExtRequestList",
    "ParamExtRequestRead",
    "ParamExtSet",
    "ParamExtValue",
    "ParamRequestList",
    "ParamRequestRead",
    "ParamSetMessage",
    "ParamValue",
    "SetupSigning",
    "SYSTEM_TIME_ID",
    "StatusText",
    "SystemTime",
]

NO_INDEX: Final = 65535
"""param_index of a PARAM_VALUE without a place in the list (PX4: `_HASH_CHECK` and parameters not in use;
ArduPilot: responses by name and pushed changes)."""
PARAMETERS_MAX: Final = 32_768
"""Parameters of a component, at most: param_index of PARAM_REQUEST_READ is signed, so no index above 32767
can be requested. A larger param_count is ignored."""
HASH_CHECK: Final = "_HASH_CHECK"
"""The param_id of PX4's hash of its table."""
COMP_ID_ALL: Final = 0
"""MAV_COMP_ID_ALL: every component of a system."""
AUTOPILOT_COMPONENT: Final = 1
"""MAV_COMP_ID_AUTOPILOT1: the usual component id of an autopilot."""
COMP_ID_MISSIONPLANNER: Final = 190
"""MAV_COMP_ID_MISSIONPLANNER: the usual component id of a ground station."""

MAV_TYPE_GENERIC: Final = 0
MAV_TYPE_GCS: Final = 6
MAV_AUTOPILOT_GENERIC: Final = 0
MAV_AUTOPILOT_ARDUPILOTMEGA: Final = 3
MAV_AUTOPILOT_INVALID: Final = 8
MAV_AUTOPILOT_PX4: Final = 12
MAV_MODE_FLAG_SAFETY_ARMED: Final = 128
MAV_STATE_BOOT: Final = 1
MAV_STATE_ACTIVE: Final = 4
HEARTBEAT_ID: Final = 0
SYSTEM_TIME_ID: Final = 2
PARAM_VALUE_ID: Final = 22
PARAM_EXT_VALUE_ID: Final = 322
AUTOPILOT_VERSION_ID: Final = 148
COMPONENT_METADATA_ID: Final = 397
MAV_CMD_PREFLIGHT_STORAGE: Final = 245
MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: Final = 246
MAV_CMD_REQUEST_MESSAGE: Final = 512
MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: Final = 520
MAV_RESULT_ACCEPTED: Final = 0
MAV_RESULT_DENIED: Final = 2
MAV_RESULT_UNSUPPORTED: Final = 3
MAV_RESULT_FAILED: Final = 4
CAPABILITY_PARAM_ENCODE_BYTEWISE: Final = 16
CAPABILITY_FTP: Final = 32
CAPABILITY_PARAM_ENCODE_C_CAST: Final = 131072


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """HEARTBEAT: the kind and the state of a component, with the numbers of MAVLink's enumerations."""

    type: int
    autopilot: int
    base_mode: int = 0
    custom_mode: int = 0
    system_status: int = 0
    mavlink_version: int = 3


@dataclass(frozen=True, slots=True)
class AutopilotVersion:
    """AUTOPILOT_VERSION; `git_hash` is flight_custom_version, `uid2` has 18 bytes."""

    capabilities: int
    flight_sw_version: int = 0
    git_hash: bytes = bytes(8)
    board_version: int = 0
    vendor_id: int = 0
    product_id: int = 0
    uid: int = 0
    uid2: bytes = bytes(18)


@dataclass(frozen=True, slots=True)
class CommandLong:
    target_system: int
    target_component: int
    command: int
    params: tuple[float, ...] = (0.0,) * 7
    confirmation: int = 0


@dataclass(frozen=True, slots=True)
class CommandAck:
    command: int
    result: int
    target_system: int = 0
    target_component: int = 0


@dataclass(frozen=True, slots=True)
class ParamRequestRead:
    """PARAM_REQUEST_READ by `param_index`, or by `param_id` where the index is −1."""

    target_system: int
    target_component: int
    param_id: str
    param_index: int = -1


@dataclass(frozen=True, slots=True)
class ParamRequestList:
    target_system: int
    target_component: int


class ParamValue(NamedTuple):
    """PARAM_VALUE; `raw` has the 4 value bytes, undecoded. A named tuple for the same reason as `Frame`."""

    param_id: str
    raw: bytes
    param_type: int
    param_count: int
    param_index: int


@dataclass(frozen=True, slots=True)
class ParamSetMessage:
    """PARAM_SET; `raw` has the 4 value bytes."""

    target_system: int
    target_component: int
    param_id: str
    raw: bytes
    param_type: int


@dataclass(frozen=True, slots=True)
class ParamError:
    """PARAM_ERROR; with `param_index` −1 the `param_id` counts; the id may be empty for a read by index."""

    target_system: int
    target_component: int
    param_id: str
    param_index: int
    error: int


@dataclass(frozen=True, slots=True)
class ParamExtRequestRead:
    """PARAM_EXT_REQUEST_READ by `param_index`, or by `param_id` where the index is −1."""

    target_system: int
    target_component: int
    param_id: str
    param_index: int = -1


@dataclass(frozen=True, slots=True)
class ParamExtRequestList:
    target_system: int
    target_component: int


class ParamExtValue(NamedTuple):
    """PARAM_EXT_VALUE, with the fields of `ParamValue`; `raw` has 128 bytes, undecoded."""

    param_id: str
    raw: bytes
    param_type: int
    param_count: int
    param_index: int


@dataclass(frozen=True, slots=True)
class ParamExtSet:
    """PARAM_EXT_SET; `raw` has up to 128 bytes, 128 when decoded."""

    target_system: int
    target_component: int
    param_id: str
    raw: bytes
    param_type: int


@dataclass(frozen=True, slots=True)
class ParamExtAck:
    """PARAM_EXT_ACK; `raw` is the new value if the result is PARAM_ACK_ACCEPTED."""

    param_id: str
    raw: bytes
    param_type: int
    param_result: int


@dataclass(frozen=True, slots=True)
class StatusText:
    severity: int
    text: str


@dataclass(frozen=True, slots=True)
class FileTransfer:
    """FILE_TRANSFER_PROTOCOL; `payload` has 251 bytes when decoded, see `paramclient.protocol.ftp`."""

    target_network: int
    target_system: int
    target_component: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class SystemTime:
    """SYSTEM_TIME; `time_unix_usec` is 0 while unknown to the vehicle."""

    time_unix_usec: int
    time_boot_ms: int


@dataclass(frozen=True, slots=True)
class HighLatency2:
    """HIGH_LATENCY2, which replaces the heartbeat on satellite links; its telemetry is left out, or zero."""

    type: int
    autopilot: int


@dataclass(frozen=True, slots=True)
class SetupSigning:
    """SETUP_SIGNING: sets a vehicle's key, in clear; without a key (zeros) it disables signing.

    There is no acknowledgement. It exists in MAVLink 2 only.
    """

    target_system: int
    target_component: int
    key: SigningKey | None
    initial_timestamp: int


@dataclass(frozen=True, slots=True)
class ComponentMetadata:
    """COMPONENT_METADATA: the location of the general metadata file, and its CRC-32; its time is not read."""

    uri: str
    file_crc: int


Message: TypeAlias = (
    Heartbeat
    | AutopilotVersion
    | CommandLong
    | CommandAck
    | ParamRequestRead
    | ParamRequestList
    | ParamValue
    | ParamSetMessage
    | ParamError
    | ParamExtRequestRead
    | ParamExtRequestList
    | ParamExtValue
    | ParamExtSet
    | ParamExtAck
    | StatusText
    | FileTransfer
    | SystemTime
    | HighLatency2
    | SetupSigning
    | ComponentMetadata
)
