"""The handshake that brings a vehicle into OFFBOARD and back: one table of phases, stepped with the time.

SEARCH -> CONNECT -> STREAM -> OFFBOARD -> ARM -> RELEASE -> FLY -> STOP -> DONE; a silent or restarted vehicle leads
back to SEARCH from anywhere, a vehicle that somebody else disarmed in flight to ABORTED, one that has crashed to LOST
by way of STOP.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import Enum, auto
from math import nan
from typing import Any

from mavsitl.codec import Frame
from mavsitl.dialect import mavlink
from mavsitl.services.command import CommandClient

PX4_MAIN_MODE_OFFBOARD = 6
SILENCE_TIMEOUT_US = 3_000_000
"""Of every message: on a lossy link three HEARTBEATs in a row are soon lost, and the state still comes."""
STREAM_TIME_US = 500_000
"""Setpoints flow this long before OFFBOARD is asked for; PX4 wants to see a stream first."""
RETRY_US = 1_000_000
"""After a refusal."""
DISARMED_TIME_US = 500_000
"""A vehicle disarmed in flight for so long was disarmed by somebody; a restarted one shows its clock before, and one
whose clock is seen to go on has not restarted.
"""
STOP_TIME_US = 120_000_000
"""Longest wait for the vehicle to land and disarm."""
FORCE_DISARM = 21196.0
NOW = -(1 << 62)
"""Of what is due: at once."""


class Phase(Enum):
    SEARCH = auto()
    CONNECT = auto()
    STREAM = auto()
    OFFBOARD = auto()
    ARM = auto()
    RELEASE = auto()
    FLY = auto()
    STOP = auto()
    DONE = auto()
    ABORTED = auto()
    LOST = auto()


ENDED = (Phase.DONE, Phase.ABORTED, Phase.LOST)


class Handshake:
    """What to ask of the vehicle next.

    `receive` takes its HEARTBEAT, EXTENDED_SYS_STATE and COMMAND_ACK; `step` the time.
    """

    def __init__(
        self,
        send_command: Callable[[int, int, tuple[float, ...]], None],
        intervals: Sequence[tuple[int, int]],
        *,
        land: bool,
        required: frozenset[int] = frozenset(),
        system_id: int | None = None,
        report: Callable[[str], None],
    ) -> None:
        """`intervals`: (message id, us) to request on connection. `land`: end by landing, else by a forced disarm.

        `required`: ids of `intervals` without which there is no flight: a refusal of one ends it before it began.
        `system_id`: fly only that vehicle; None: the first autopilot heard.
        """
        self._client = CommandClient(send_command)
        self._intervals = intervals
        self._land = land
        self._required = required
        self._wanted_system = system_id
        self._report = report
        self._to_ask: list[tuple[int, int]] = []
        self._asked: int | None = None
        self._phase_us = 0
        self._retry_us = 0
        self._heard_us = -1
        self._disarmed_us: int | None = None
        self._boots = False
        self.phase = Phase.SEARCH
        self.lost = ""
        """How the vehicle was lost in flight; empty: it was not."""
        self.clock_goes_on = False
        """Of the vehicle, since its last HEARTBEAT."""
        self.target: tuple[int, int] | None = None
        self.armed = False
        self.offboard = False
        self.landed_state = mavlink.MAV_LANDED_STATE_UNDEFINED

    @property
    def in_control(self) -> bool:
        """Flying, and the vehicle follows: a fail-safe or a pilot's mode change ends this, but not the flight."""
        return self.phase is Phase.FLY and self.offboard and self.armed

    @property
    def due_us(self) -> int:
        """When `step` may have something to do, unless a message but the state comes before; in flight it is silence
        alone that is waited for.
        """
        quiet = self.phase is Phase.FLY and self.armed and not self._boots and not self._client.busy
        return self._heard_us + SILENCE_TIMEOUT_US if quiet else NOW

    def accepts(self, system_id: int, component_id: int) -> bool:
        """Is this sender the vehicle that is flown?"""
        return self.target == (system_id, component_id)

    def on_heartbeat(self, message: Any, system_id: int, component_id: int, now_us: int) -> None:
        is_autopilot = (
            message.autopilot != mavlink.MAV_AUTOPILOT_INVALID and component_id == mavlink.MAV_COMP_ID_AUTOPILOT1
        )
        if not is_autopilot or self._wanted_system not in (None, system_id):
            return
        if message.system_status == mavlink.MAV_STATE_BOOT:
            # Its last run is over, and it answers nothing yet.
            self._boots = self._boots or self.target == (system_id, component_id)
            return
        if self.target is None:
            self.target = (system_id, component_id)
            self._report(f"vehicle {system_id} found")
        if self.target != (system_id, component_id):
            return
        self._heard_us = now_us
        self.clock_goes_on = False
        self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        self.offboard = message.custom_mode >> 16 & 0xFF == PX4_MAIN_MODE_OFFBOARD

    def on_state(self, newer: bool, now_us: int) -> None:
        """A position or attitude of the vehicle that is flown; `newer`: by its clock."""
        self._heard_us = now_us
        if newer:
            self.clock_goes_on = True

    def on_message(self, frame: Frame, now_us: int) -> None:
        """From the vehicle that is flown."""
        self._heard_us = now_us
        if frame.message_id == mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE:
            self.landed_state = frame.message.landed_state
        elif frame.message_id == mavlink.MAVLINK_MSG_ID_COMMAND_ACK:
            self._client.receive(frame.message)

    def lose(self, why: str, now_us: int) -> None:
        """Back to the start: the vehicle fell silent or started anew."""
        if self.phase in ENDED:
            return
        self._report(f"vehicle lost: {why}")
        self._client.cancel()
        self.target = None
        self.armed = self.offboard = False
        self.landed_state = mavlink.MAV_LANDED_STATE_UNDEFINED
        self._enter(Phase.SEARCH, now_us)

    def crash(self, how: str, now_us: int) -> None:
        """The vehicle will not fly any more: stop its rotors where it lies."""
        self.lost = how
        self._report(f"crashed: {how}")
        self._land = False
        self._client.cancel()
        self._enter(Phase.STOP, now_us)

    def fail(self, how: str, now_us: int) -> None:
        """The controller cannot go on: a vehicle that flies lands, or is disarmed where there is no ground."""
        if self.phase not in (*ENDED, Phase.STOP):
            self.lost = how
            self._client.cancel()
            self._enter(Phase.STOP, now_us)

    def finish(self, now_us: int) -> None:
        """The flight's time is over."""
        self._enter(Phase.STOP, now_us)

    def step(self, now_us: int) -> None:
        if self._boots:
            self._boots = False
            self.lose("it boots", now_us)
        elif self.target is not None and now_us - self._heard_us > SILENCE_TIMEOUT_US:
            self.lose(f"silent for {SILENCE_TIMEOUT_US / 1e6:g} s", now_us)
        _STEPS[self.phase](self, now_us)
        self._client.step(now_us)

    def _enter(self, phase: Phase, now_us: int) -> None:
        self.phase = phase
        self._phase_us = now_us
        self._retry_us = 0
        self._disarmed_us = None

    def _search(self, now_us: int) -> None:
        if self.target is not None:
            self._to_ask = list(self._intervals)
            self._enter(Phase.CONNECT, now_us)
            self._connect(now_us)

    def _connect(self, now_us: int) -> None:
        if self._client.busy:
            return
        if self._asked is not None and self._client.result != mavlink.MAV_RESULT_ACCEPTED:
            said = "no answer" if self._client.result is None else f"MAV_RESULT {self._client.result}"
            self._report(f"the vehicle does not stream message {self._asked} as asked ({said})")
            if self._asked in self._required:
                self._report(f"no flight without message {self._asked}: the scenario needs it")
                self._enter(Phase.ABORTED, now_us)
                return
        self._asked = None
        if self._to_ask:
            message_id, interval_us = self._to_ask.pop(0)
            self._asked = message_id
            self._client.start(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, interval_us, 0, 0, 0, 0, 0)
        else:
            self._client.result = None
            self._enter(Phase.STREAM, now_us)

    def _stream(self, now_us: int) -> None:
        if now_us - self._phase_us >= STREAM_TIME_US:
            self._enter(Phase.OFFBOARD, now_us)
            self._request_offboard(now_us)

    def _request_offboard(self, now_us: int) -> None:
        if self.offboard:
            self._client.cancel()
            self._enter(Phase.ARM, now_us)
            self._arm(now_us)
        else:
            custom = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
            self._ask(
                "OFFBOARD", now_us, mavlink.MAV_CMD_DO_SET_MODE, custom, PX4_MAIN_MODE_OFFBOARD, 0, nan, nan, nan, nan
            )

    def _arm(self, now_us: int) -> None:
        if self.armed:
            self._client.cancel()
            self._enter(Phase.RELEASE, now_us)
        elif not self.offboard:
            self._enter(Phase.OFFBOARD, now_us)
        else:
            self._ask("arming", now_us, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1, 0, nan, nan, nan, nan, nan)

    def _release(self, now_us: int) -> None:
        if not self.armed:
            self._enter(Phase.STREAM, now_us)
        elif self.landed_state in (mavlink.MAV_LANDED_STATE_IN_AIR, mavlink.MAV_LANDED_STATE_TAKEOFF):
            self._report("flying")
            self._enter(Phase.FLY, now_us)

    def _fly(self, now_us: int) -> None:
        if self.armed:
            self._disarmed_us = None
        elif self._disarmed_us is None:
            self._disarmed_us = now_us
        if self._disarmed_us is not None and (self.clock_goes_on or now_us - self._disarmed_us >= DISARMED_TIME_US):
            self.lost = "the vehicle was disarmed in flight"
            self._report(self.lost)
            self._enter(Phase.ABORTED, now_us)

    def _stop(self, now_us: int) -> None:
        if not self.armed:
            self._client.cancel()
            self._enter(Phase.LOST if self.lost else Phase.DONE, now_us)
        elif now_us - self._phase_us >= STOP_TIME_US:
            self._report(f"the vehicle did not disarm within {STOP_TIME_US / 1e6:g} s")
            self._enter(Phase.ABORTED, now_us)
        elif self._land:
            if self.offboard:
                self._ask("landing", now_us, mavlink.MAV_CMD_NAV_LAND, nan, nan, nan, nan, nan, nan, nan)
        else:
            self._ask(
                "disarming", now_us, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, FORCE_DISARM, nan, nan, nan, nan, nan
            )

    def _nothing(self, now_us: int) -> None:
        pass

    def _ask(self, what: str, now_us: int, command: int, *params: float) -> None:
        if self._client.busy or now_us < self._retry_us:
            return
        if self._client.result not in (None, mavlink.MAV_RESULT_ACCEPTED):
            self._report(f"{what} refused (MAV_RESULT {self._client.result}), asking again")
            self._client.result = None
            self._retry_us = now_us + RETRY_US
            return
        self._retry_us = now_us + RETRY_US
        self._client.start(command, *params)


_STEPS: dict[Phase, Callable[[Handshake, int], None]] = {
    Phase.SEARCH: Handshake._search,
    Phase.CONNECT: Handshake._connect,
    Phase.STREAM: Handshake._stream,
    Phase.OFFBOARD: Handshake._request_offboard,
    Phase.ARM: Handshake._arm,
    Phase.RELEASE: Handshake._release,
    Phase.FLY: Handshake._fly,
    Phase.STOP: Handshake._stop,
    Phase.DONE: Handshake._nothing,
    Phase.ABORTED: Handshake._nothing,
    Phase.LOST: Handshake._nothing,
}
