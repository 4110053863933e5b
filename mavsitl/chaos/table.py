"""The modes of protocol chaos by name: `TABLE` is what there is, `parse` reads ``NAME[:ARGUMENT...][@PORT]``."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from math import isfinite
from typing import Any, NamedTuple

from mavsitl.chaos import commands, files, missions, parameters, telemetry
from mavsitl.chaos.base import Double, Ignore, Lose, Mode
from mavsitl.dialect import mavlink
from mavsitl.errors import UsageError, did_you_mean

__all__ = ["ALL_PORTS", "PORTS", "TABLE", "Argument", "ChaosError", "Row", "Spec", "parse"]

ALL_PORTS = "all"
PORTS = (ALL_PORTS, "offboard", "gcs")


class ChaosError(UsageError):
    """A mode, an argument or a port that does not exist; the message names what does."""


class Argument(NamedTuple):
    """One argument of a mode. `read` raises `ValueError` with what is allowed."""

    name: str
    read: Callable[[str], Any]
    default: str
    """As the user would write it; empty: all, or none."""

    @property
    def is_parameter(self) -> bool:
        return self.read is _name


class Row(NamedTuple):
    """One mode."""

    group: str
    text: str
    """What it does, in a line."""
    make: Callable[..., Mode]
    arguments: tuple[Argument, ...] = ()
    mocklink: str = ""
    """The name of the same in QGroundControl's MockLink, where it has it."""

    def usage(self, name: str) -> str:
        """``ack-late[:seconds[:command]]``"""
        return name + "".join(f"[:{each.name}" for each in self.arguments) + "]" * len(self.arguments)


class Spec(NamedTuple):
    """A mode as it was asked for."""

    name: str
    values: tuple[Any, ...]
    port: str

    def make(self) -> Mode:
        return TABLE[self.name].make(*self.values)


# --- arguments -------------------------------------------------------------------------------------------------------


def _number(least: float, most: float, words: str, whole: bool = False) -> Callable[[str], float]:
    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not (isfinite(value) and least <= value <= most) or (whole and value != int(value)):
            raise ValueError(words)
        return int(value) if whole else value

    return read


def _enumeration(enum: str, *, begin: str = "", most: int = 255, optional: bool = False) -> Callable[[str], int | None]:
    """A value of a MAVLink enumeration by its number or its name, with or without `begin`: the enumeration's own."""
    begin = begin or f"{enum}_"

    def read(text: str) -> int | None:
        if not text and optional:
            return None
        if text.isascii() and text.isdigit() and int(text) <= most:
            return int(text)
        names: dict[str, int] = {
            str(entry.name): number
            for number, entry in mavlink.enums[enum].items()
            if not str(entry.name).endswith("_ENUM_END")
        }
        name = begin + text.upper().removeprefix(begin)
        if name in names:
            return names[name]
        near = [each.removeprefix(begin) for each in get_close_matches(name, names, 3) or list(names)[:6]]
        raise ValueError(f"a number or a name of {enum}, for example {', '.join(near)}")

    return read


def _message_id(text: str) -> int | None:
    if not text:
        return None
    if text.isascii() and text.isdigit() and int(text) < 2**24:
        return int(text)
    names: dict[str, int] = {str(kind.msgname): number for number, kind in mavlink.mavlink_map.items()}
    if text.upper() in names:
        return names[text.upper()]
    near = get_close_matches(text.upper(), names, 3) or ["HOME_POSITION"]
    raise ValueError(f"a number or a name of a message, for example {', '.join(near)}")


def _name(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_]{1,16}", text):
        raise ValueError("a parameter's name, 1 to 16 characters")
    return text


_whole = _number(0, 65535, "a whole number from 0 to 65535", whole=True)
_from_one = _number(1, 65535, "a whole number from 1 to 65535", whole=True)
_seconds = _number(1e-3, 3600.0, "seconds from 0.001 to 3600")
_seconds_or_none = _number(0.0, 3600.0, "seconds from 0 (for good) to 3600")
_share = _number(0.0, 1.0, "a share from 0 to 1")
_hz = _number(0.01, 1000.0, "a rate from 0.01 to 1000 Hz")

COMMAND = Argument("command", _enumeration("MAV_CMD", most=0xFFFF, optional=True), "")
REQUIRED_COMMAND = Argument("command", _enumeration("MAV_CMD", most=0xFFFF), "DO_SET_MODE")
RESULT = Argument("result", _enumeration("MAV_RESULT"), "DENIED")
MISSION_RESULT = Argument("result", _enumeration("MAV_MISSION_RESULT", begin="MAV_MISSION_"), "ERROR")
PARAMETER = Argument("parameter", _name, "MIS_TAKEOFF_ALT")
MESSAGE = Argument("message", _message_id, "")


def _every(default: int) -> Argument:
    return Argument("n", _from_one, f"{default}")


def _item(default: int) -> Argument:
    return Argument("item", _whole, f"{default}")


def _after(default: float) -> Argument:
    return Argument("seconds", _seconds, f"{default:g}")


def _times(default: int) -> Argument:
    return Argument("times", _from_one, f"{default}")


# --- the modes -------------------------------------------------------------------------------------------------------

_M = mavlink
_COMMAND, _HEARTBEAT, _PARAMETER, _MISSION, _FTP, _MESSAGES, _FRAMES = (
    "Commands", "Signs of life", "Parameters", "Missions, fences, rally points", "Files and logs",
    "Telemetry and requests", "Frames",
)  # fmt: skip

MODE_COMMANDS = (
    _M.MAV_CMD_DO_SET_MODE, _M.MAV_CMD_DO_SET_STANDARD_MODE, _M.MAV_CMD_NAV_TAKEOFF, _M.MAV_CMD_NAV_LAND,
    _M.MAV_CMD_NAV_RETURN_TO_LAUNCH, _M.MAV_CMD_MISSION_START, _M.MAV_CMD_DO_PAUSE_CONTINUE, _M.MAV_CMD_DO_ORBIT,
    _M.MAV_CMD_DO_REPOSITION,
)  # fmt: skip
VERSION: int = _M.MAVLINK_MSG_ID_AUTOPILOT_VERSION


def _named(**fields: Any) -> Callable[[Any], dict[str, Any]]:
    return lambda message: fields


TABLE: Mapping[str, Row] = {
    "ack-lost": Row(_COMMAND, "done, no COMMAND_ACK", commands.AckLost, (COMMAND,)),
    "ack-first-lost": Row(
        _COMMAND, "done, the first COMMAND_ACKs of each command are lost; a repeat is answered",
        commands.AckFirstLost, (_times(1), COMMAND),
    ),
    "ack-late": Row(_COMMAND, "done at once, COMMAND_ACK so much later", commands.AckLate, (_after(2.5), COMMAND)),
    "ack-doubled": Row(_COMMAND, "every COMMAND_ACK comes twice", commands.AckDoubled, (COMMAND,)),
    "ack-refused": Row(
        _COMMAND, "not done, answered with this MAV_RESULT",
        lambda result, command: commands.Answered(result, 0, command), (RESULT, COMMAND),
    ),
    "ack-busy": Row(
        _COMMAND, "not done, TEMPORARILY_REJECTED so many times; then done and accepted",
        lambda times, command: commands.Answered(commands.TEMPORARILY_REJECTED, times, command), (_times(2), COMMAND),
    ),
    "ack-progress-forever": Row(
        _COMMAND, "not done, IN_PROGRESS twice a second for as long as the mode lasts",
        commands.ProgressForEver, (COMMAND,),
    ),
    "ack-progress-stuck": Row(
        _COMMAND, "not done, IN_PROGRESS once and no final answer", commands.ProgressStuck, (COMMAND,)
    ),
    "ack-progress-accepted": Row(
        _COMMAND, "done at once, IN_PROGRESS for so long, then the true answer",
        commands.ProgressThenResult, (_after(2.0), COMMAND),
    ),
    "ack-progress-failed": Row(
        _COMMAND, "not done, IN_PROGRESS for so long, then FAILED",
        commands.ProgressThenFailed, (_after(2.0), COMMAND),
    ),
    "ack-wrong-command": Row(
        _COMMAND, "done, COMMAND_ACK names the next command's number",
        lambda command: commands.AckAltered(commands.another_command, command), (COMMAND,),
    ),
    "ack-wrong-target": Row(
        _COMMAND, "done, COMMAND_ACK is addressed to another system",
        lambda command: commands.AckAltered(commands.another_target, command), (COMMAND,),
    ),
    "ack-no-target": Row(
        _COMMAND, "done, COMMAND_ACK is addressed to nobody (0/0), as of old autopilots: still good",
        lambda command: commands.AckAltered(commands.no_target, command), (COMMAND,),
    ),
    "ack-unasked": Row(
        _COMMAND, "a COMMAND_ACK that accepts a command of nobody's, this often",
        commands.AckUnasked, (REQUIRED_COMMAND, _after(1.0)), "sendUnexpectedCommandAck",
    ),
    "command-lost": Row(_COMMAND, "not done, not answered", commands.CommandLost, (COMMAND,)),
    "command-first-lost": Row(
        _COMMAND, "each command is not looked at so many times; a repeat is done",
        commands.CommandFirstLost, (_times(1), COMMAND),
    ),
    "command-not-done": Row(
        _COMMAND, "accepted, not done", lambda command: commands.Answered(commands.ACCEPTED, 0, command), (COMMAND,)
    ),
    "arm-not-done": Row(
        _COMMAND, "arming and disarming are accepted, not done",
        lambda: commands.NotDone(_M.MAV_CMD_COMPONENT_ARM_DISARM),
    ),
    "mode-not-done": Row(
        _COMMAND, "what would change the mode is accepted, not done",
        lambda: commands.NotDone(*MODE_COMMANDS, set_mode=True),
    ),
    "user-commands": Row(
        _COMMAND,
        "31010 is accepted, 31011 failed; 31012 and 31013 the same at the second try; 31014 and 31015 never answered; "
        "31016 and 31017 after IN_PROGRESS; 31018 stays IN_PROGRESS",
        commands.UserCommands, (), "MAV_CMD_MOCKLINK_*",
    ),
    "heartbeat-lost": Row(_HEARTBEAT, "no HEARTBEAT; all else goes on", lambda: Lose("HEARTBEAT")),
    "heartbeat-slow": Row(_HEARTBEAT, "a HEARTBEAT this often", telemetry.Slow, (_after(4.0),)),
    "heartbeat-other-system": Row(
        _HEARTBEAT, "every second HEARTBEAT comes from the next system id", telemetry.OtherSystem
    ),
    "heartbeat-autopilot": Row(
        _HEARTBEAT, "HEARTBEAT names this MAV_AUTOPILOT",
        lambda value: telemetry.Altered("HEARTBEAT", _named(autopilot=value)),
        (Argument("autopilot", _enumeration("MAV_AUTOPILOT"), "ARDUPILOTMEGA"),),
    ),
    "heartbeat-type": Row(
        _HEARTBEAT, "HEARTBEAT names this MAV_TYPE",
        lambda value: telemetry.Altered("HEARTBEAT", _named(type=value)),
        (Argument("type", _enumeration("MAV_TYPE"), "FIXED_WING"),),
    ),
    "comm-lost": Row(
        _HEARTBEAT, "nothing is sent, nothing is looked at, for so long; 0: for good",
        lambda seconds: telemetry.Silent(seconds, mute=True, deaf=True),
        (Argument("seconds", _seconds_or_none, "0"),), "setCommLost",
    ),
    "mute": Row(
        _HEARTBEAT, "nothing is sent, for so long; 0: for good",
        lambda seconds: telemetry.Silent(seconds, mute=True, deaf=False),
        (Argument("seconds", _seconds_or_none, "0"),),
    ),
    "deaf": Row(
        _HEARTBEAT, "nothing is looked at, for so long; 0: for good",
        lambda seconds: telemetry.Silent(seconds, mute=False, deaf=True),
        (Argument("seconds", _seconds_or_none, "0"),),
    ),
    "param-list-ignored": Row(
        _PARAMETER, "PARAM_REQUEST_LIST is not looked at", lambda: Ignore("PARAM_REQUEST_LIST"), (),
        "FailParamNoResponseToRequestList",
    ),
    "param-list-without": Row(
        _PARAMETER, "the list leaves this parameter out; who asks for it gets it",
        parameters.ListWithout, (PARAMETER,), "FailMissingParamOnInitialRequest",
    ),
    "param-missing": Row(
        _PARAMETER, "this parameter is never told", parameters.NameLost, (PARAMETER,), "FailMissingParamOnAllRequests"
    ),
    "param-list-ends": Row(
        _PARAMETER, "the list ends after so many values; single ones are answered",
        parameters.ListEnds, (Argument("count", _from_one, "50"),),
    ),
    "param-count-wrong": Row(
        _PARAMETER, "`param_count` is so many too high", parameters.CountWrong, (Argument("more", _from_one, "1"),)
    ),
    "param-index-doubled": Row(
        _PARAMETER, "every second parameter has the index of the one before it", parameters.IndexDoubled
    ),
    "param-doubled": Row(_PARAMETER, "every PARAM_VALUE comes twice", lambda: Double("PARAM_VALUE")),
    "param-type-wrong": Row(_PARAMETER, "INT32 is said to be REAL32 and the other way round", parameters.TypeWrong),
    "param-nan": Row(_PARAMETER, "this parameter's value is told as NaN", parameters.NotANumber, (PARAMETER,)),
    "param-hash-silent": Row(
        _PARAMETER, "_HASH_CHECK is never told", parameters.HashSilent, (), "setHashCheckNoResponse"
    ),
    "param-set-ignored": Row(
        _PARAMETER, "PARAM_SET: not set, not answered", lambda: parameters.Ignored("PARAM_SET", 0), (),
        "FailParamSetNoAck",
    ),
    "param-set-first-ignored": Row(
        _PARAMETER, "PARAM_SET: each parameter's is not looked at so many times; a repeat is done",
        lambda times: parameters.Ignored("PARAM_SET", times), (_times(1),), "FailParamSetFirstAttemptNoAck",
    ),
    "param-set-unanswered": Row(_PARAMETER, "PARAM_SET: set, not answered", parameters.SetUnanswered),
    "param-set-refused": Row(
        _PARAMETER, "PARAM_SET: not set, PARAM_ERROR",
        lambda error: parameters.Refused("PARAM_SET", error),
        (Argument("error", _enumeration("MAV_PARAM_ERROR"), "VALUE_OUT_OF_RANGE"),), "FailParamSetParamError",
    ),
    "param-set-kept": Row(
        _PARAMETER, "PARAM_SET: not set, answered with the old value", parameters.SetKept
    ),
    "param-read-ignored": Row(
        _PARAMETER, "PARAM_REQUEST_READ is not answered", lambda: parameters.Ignored("PARAM_REQUEST_READ", 0), (),
        "FailParamRequestReadNoResponse",
    ),
    "param-read-first-ignored": Row(
        _PARAMETER, "PARAM_REQUEST_READ: each parameter's is not answered so many times; a repeat is",
        lambda times: parameters.Ignored("PARAM_REQUEST_READ", times), (_times(1),),
        "FailParamRequestReadFirstAttemptNoResponse",
    ),
    "param-read-refused": Row(
        _PARAMETER, "PARAM_REQUEST_READ: PARAM_ERROR",
        lambda error: parameters.Refused("PARAM_REQUEST_READ", error),
        (Argument("error", _enumeration("MAV_PARAM_ERROR"), "DOES_NOT_EXIST"),), "FailParamRequestReadParamError",
    ),
    "mission-count-lost": Row(
        _MISSION, "download: no MISSION_COUNT", lambda: Lose("MISSION_COUNT"), (), "FailReadRequestListNoResponse"
    ),
    "mission-count-first-lost": Row(
        _MISSION, "download: the first MISSION_COUNT is lost; a repeat is answered",
        missions.CountFirstLost, (), "FailReadRequestListFirstResponse",
    ),
    "mission-count-wrong": Row(
        _MISSION, "download: MISSION_COUNT promises so many more",
        missions.CountWrong, (Argument("more", _from_one, "1"),),
    ),
    "mission-item-lost": Row(
        _MISSION, "download: this item is never sent",
        lambda seq: missions.SequenceLost(missions.ITEMS, seq), (_item(0),),
        "FailReadRequest0NoResponse, FailReadRequest1NoResponse",
    ),
    "mission-item-first-lost": Row(
        _MISSION, "download: this item is lost once; a repeat is answered",
        lambda seq: missions.SequenceLost(missions.ITEMS, seq, 1), (_item(1),), "FailReadRequest1FirstResponse",
    ),
    "mission-item-wrong-seq": Row(
        _MISSION, "download: this item says the next one's number",
        lambda seq: missions.SequenceWrong(missions.ITEMS, seq), (_item(0),),
        "FailReadRequest0IncorrectSequence, FailReadRequest1IncorrectSequence",
    ),
    "mission-item-refused": Row(
        _MISSION, "download: MISSION_ACK with this MAV_MISSION_RESULT in the place of this item",
        missions.ItemRefused, (_item(0), MISSION_RESULT), "FailReadRequest0ErrorAck, FailReadRequest1ErrorAck",
    ),
    "mission-begin-ignored": Row(
        _MISSION, "upload: MISSION_COUNT is not looked at", lambda: Ignore("MISSION_COUNT"), (),
        "FailWriteMissionCountNoResponse",
    ),
    "mission-begin-first-ignored": Row(
        _MISSION, "upload: the first MISSION_COUNT is not looked at; a repeat is",
        missions.BeginFirstLost, (), "FailWriteMissionCountFirstResponse",
    ),
    "mission-request-lost": Row(
        _MISSION, "upload: this item is never asked for; the upload is given up after 5 s",
        lambda seq: missions.SequenceLost(missions.REQUESTS, seq), (_item(1),), "FailWriteRequest1NoResponse",
    ),
    "mission-request-wrong-seq": Row(
        _MISSION, "upload: the next item is asked for in the place of this one",
        lambda seq: missions.SequenceWrong(missions.REQUESTS, seq), (_item(0),),
        "FailWriteRequest0IncorrectSequence, FailWriteRequest1IncorrectSequence",
    ),
    "mission-request-refused": Row(
        _MISSION, "upload: MISSION_ACK with this MAV_MISSION_RESULT in the place of the request for this item",
        missions.UploadEnds, (_item(0), MISSION_RESULT), "FailWriteRequest0ErrorAck, FailWriteRequest1ErrorAck",
    ),
    "mission-ack-lost": Row(
        _MISSION, "upload: taken, no MISSION_ACK", lambda: Lose("MISSION_ACK"), (), "FailWriteFinalAckNoResponse"
    ),
    "mission-ack-error": Row(
        _MISSION, "upload: taken, MISSION_ACK says this MAV_MISSION_RESULT",
        missions.AckAltered, (MISSION_RESULT,), "FailWriteFinalAckErrorAck",
    ),
    "mission-ack-early": Row(
        _MISSION, "upload: MISSION_ACK accepts before this item was asked for; the old plan stays",
        lambda seq: missions.UploadEnds(seq, _M.MAV_MISSION_ACCEPTED), (_item(3),), "FailWriteFinalAckMissingRequests",
    ),
    "mission-ack-late": Row(_MISSION, "upload: MISSION_ACK so much later", missions.AckLate, (_after(2.5),)),
    "mission-ack-doubled": Row(_MISSION, "every MISSION_ACK comes twice", lambda: Double("MISSION_ACK")),
    "mission-ack-unasked": Row(
        _MISSION, "a MISSION_ACK with an error for nobody, this often",
        lambda seconds: missions.Unasked("ack", seconds), (_after(1.0),), "sendUnexpectedMissionAck",
    ),
    "mission-item-unasked": Row(
        _MISSION, "a MISSION_ITEM_INT that nobody asked for, this often",
        lambda seconds: missions.Unasked("item", seconds), (_after(1.0),), "sendUnexpectedMissionItem",
    ),
    "mission-request-unasked": Row(
        _MISSION, "a MISSION_REQUEST_INT of no upload, this often",
        lambda seconds: missions.Unasked("request", seconds), (_after(1.0),), "sendUnexpectedMissionRequest",
    ),
    "mission-reached-lost": Row(_MISSION, "no MISSION_ITEM_REACHED", lambda: Lose("MISSION_ITEM_REACHED")),
    "ftp-silent": Row(
        _FTP, "no request is looked at", lambda: Ignore("FILE_TRANSFER_PROTOCOL"), (), "errModeNoResponse"
    ),
    "ftp-nak": Row(
        _FTP, "every request is refused with this MAV_FTP_ERR", lambda error: files.Nak(error, later=False),
        (Argument("error", _enumeration("MAV_FTP_ERR"), "FAIL"),), "errModeNakResponse",
    ),
    "ftp-second-silent": Row(
        _FTP, "opening is answered, nothing after it", lambda: files.SecondSilent(once=False), (),
        "errModeNoSecondResponse",
    ),
    "ftp-second-first-silent": Row(
        _FTP, "the first request after opening is not looked at; a repeat is answered",
        lambda: files.SecondSilent(once=True), (), "errModeNoSecondResponseAllowRetry",
    ),
    "ftp-second-nak": Row(
        _FTP, "opening is answered, everything after it refused with this MAV_FTP_ERR",
        lambda error: files.Nak(error, later=True),
        (Argument("error", _enumeration("MAV_FTP_ERR"), "FAIL"),), "errModeNakSecondResponse",
    ),
    "ftp-bad-sequence": Row(
        _FTP, "replies have a sequence number one too high", files.SequenceWrong, (), "errModeBadSequence"
    ),
    "ftp-wrong-session": Row(_FTP, "replies name another session", files.SessionWrong),
    "ftp-drops": Row(
        _FTP, "this share of requests and replies is lost, by chance",
        lambda share: files.Drops(share, "FILE_TRANSFER_PROTOCOL"), (Argument("share", _share, "0.2"),),
        "enableRandomDrops",
    ),
    "ftp-wrong-size": Row(
        _FTP, "a file is said to be so many bytes longer", files.SizeWrong, (Argument("more", _from_one, "100"),)
    ),
    "ftp-cut": Row(_FTP, "files end after this share of their size", files.Cut, (Argument("share", _share, "0.5"),)),
    "ftp-gaps": Row(
        _FTP, "every n-th reply with data is lost", lambda n: files.EveryDataReply(n, lost=True), (_every(5),)
    ),
    "ftp-corrupt": Row(
        _FTP, "every n-th reply with data has a wrong byte", lambda n: files.EveryDataReply(n, lost=False), (_every(5),)
    ),
    "log-silent": Row(
        _FTP, "no request for logs is looked at",
        lambda: Ignore("LOG_REQUEST_LIST", "LOG_REQUEST_DATA", "LOG_REQUEST_END", "LOG_ERASE"),
    ),
    "log-drops": Row(
        _FTP, "this share of LOG_DATA is lost, by chance",
        lambda share: files.Drops(share, "LOG_DATA"), (Argument("share", _share, "0.2"),),
    ),
    "log-wrong-size": Row(
        _FTP, "a log is said to be so many bytes longer", files.LogSizeWrong, (Argument("more", _from_one, "1000"),)
    ),
    "version-refused": Row(
        _MESSAGES, "AUTOPILOT_VERSION, asked for: refused with this MAV_RESULT",
        lambda result: commands.RequestAnswered(result, VERSION),
        (RESULT._replace(default="FAILED"),), "FailInitialConnectRequestMessageAutopilotVersionFailure",
    ),
    "version-lost": Row(
        _MESSAGES, "AUTOPILOT_VERSION, asked for: accepted, not sent",
        lambda: commands.RequestAnswered(commands.ACCEPTED, VERSION), (),
        "FailInitialConnectRequestMessageAutopilotVersionLost",
    ),
    "request-not-sent": Row(
        _MESSAGES, "a message asked for (all, or this one): accepted, not sent",
        lambda message_id: commands.RequestAnswered(commands.ACCEPTED, message_id), (MESSAGE,),
        "FailRequestMessageCommandAcceptedMsgNotSent",
    ),
    "request-unsupported": Row(
        _MESSAGES, "a message asked for (all, or this one): UNSUPPORTED",
        lambda message_id: commands.RequestAnswered(_M.MAV_RESULT_UNSUPPORTED, message_id), (MESSAGE,),
        "FailRequestMessageCommandUnsupported",
    ),
    "request-silent": Row(
        _MESSAGES, "a message asked for (all, or this one): no answer, not sent",
        lambda message_id: commands.RequestAnswered(None, message_id), (MESSAGE,),
        "FailRequestMessageCommandNoResponse, setRequestMessageNoResponse",
    ),
    "timesync-silent": Row(_MESSAGES, "TIMESYNC is not answered", lambda: Ignore("TIMESYNC")),
    "timesync-jumps": Row(
        _MESSAGES, "each TIMESYNC answer is wrong by chance, up to so much", telemetry.TimesyncJumps, (_after(0.5),)
    ),
    "ping-silent": Row(_MESSAGES, "PING is not answered", lambda: Ignore("PING")),
    "system-time-garbage": Row(_MESSAGES, "SYSTEM_TIME holds random numbers", telemetry.SystemTimeGarbage),
    "home-lost": Row(_MESSAGES, "no HOME_POSITION, asked for or not", lambda: Lose("HOME_POSITION")),
    "landed-unknown": Row(
        _MESSAGES, "EXTENDED_SYS_STATE: MAV_LANDED_STATE_UNDEFINED",
        lambda: telemetry.Altered("EXTENDED_SYS_STATE", _named(landed_state=_M.MAV_LANDED_STATE_UNDEFINED)),
    ),
    "text-flood": Row(
        _MESSAGES, "so many STATUSTEXTs a second", telemetry.TextFlood, (Argument("hz", _hz, "50"),)
    ),
    "text-chunk-lost": Row(
        _MESSAGES, "the second part of a long STATUSTEXT is lost", telemetry.ChunkLost, (), "_sendChunkedStatusText"
    ),
    "telemetry-stopped": Row(
        _MESSAGES, "telemetry ends; HEARTBEAT, texts and answers go on", telemetry.Stopped
    ),
    "telemetry-frozen": Row(
        _MESSAGES, "telemetry repeats one moment, time stamps and all; HEARTBEAT, texts and answers go on",
        telemetry.Frozen,
    ),
    "sequence-gaps": Row(
        _FRAMES, "before every n-th frame a sequence number is left out", telemetry.SequenceGaps, (_every(10),)
    ),
    "crc-wrong": Row(_FRAMES, "every n-th frame has a wrong checksum", telemetry.CrcWrong, (_every(10),)),
    "frame-cut": Row(_FRAMES, "every n-th frame ends in its middle", telemetry.FrameCut, (_every(10),)),
    "frame-unknown": Row(
        _FRAMES, "every n-th frame is followed by one of a message that no dialect has",
        telemetry.UnknownMessage, (_every(10),),
    ),
}  # fmt: skip
"""Every mode there is."""


def parse(text: str) -> Spec:
    """Read ``NAME[:ARGUMENT...][@PORT]``, e.g. ``ack-late:2.5:NAV_TAKEOFF@gcs``. Raises `ChaosError`."""
    mode, at, port = text.partition("@")
    if at and port not in PORTS:
        raise ChaosError(f"chaos mode '{text}': port '{port}' is not allowed; allowed: {', '.join(PORTS)}")
    name, *given = mode.split(":")
    row = TABLE.get(name)
    if row is None:
        raise ChaosError(f"no chaos mode '{name}'; {did_you_mean(name, TABLE)}'mavsitl chaos' lists all")
    if len(given) > len(row.arguments):
        raise ChaosError(f"chaos mode '{text}': too many arguments; allowed: {row.usage(name)}")
    values = []
    for argument, value in zip(row.arguments, given + [""] * (len(row.arguments) - len(given)), strict=True):
        try:
            values.append(argument.read(value or argument.default))
        except ValueError as error:
            raise ChaosError(
                f"chaos mode '{text}': {argument.name}: '{value}' is not allowed; allowed: {error}"
            ) from None
    return Spec(name, tuple(values), port or ALL_PORTS)
