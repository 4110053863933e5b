"""What a vehicle keeps between starts: parameters, plans, signing key and memory card, and the files they are in."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from mavsitl.keep import Work
from mavsitl.scenario import Flight
from mavsitl.services.files import Folder, Quota
from mavsitl.signing import EPOCH_UNIX_US, Signing, SigningMode, SigningState
from mavsitl_vehicle.autopilot.parameters import Layer, Parameters
from mavsitl_vehicle.autopilot.plan import PlanError, VehiclePlan
from mavsitl_vehicle.autopilot.ports import Shared
from mavsitl_vehicle.autopilot.storage import Store, keep_parameters
from mavsitl_vehicle.links import initial_links

PLAN_SCHEMA = 1
SIGNING_SCHEMA = 1


class Kept:
    """One vehicle's, read before there is an autopilot.

    Attributes:
        signing: None: there is no clock for it.
        notes: what was wrong, as long as nobody has set `warn`.
        warn: takes a line for whoever flies the vehicle.
        say: takes a severity and a line about the plan.
    """

    def __init__(
        self,
        flight: Flight,
        *,
        system_id: int = 1,
        state: Path | None = None,
        logs: Path | None = None,
        unix_us: Callable[[], int] | None = None,
        trusted: bool = True,
    ) -> None:
        """The arguments are those of `mavsitl_vehicle.vehicle.Vehicle`."""
        self.notes: list[str] = []
        self.warn: Callable[[str], None] = self.notes.append
        self.say: Callable[[int, str], None] = lambda severity, text: self.warn(text)
        self.unix_us = unix_us
        self.parameters = Parameters(
            *(Layer(name, values) for name, values in initial_links(flight.scenario).items()),
            Layer(f"airframe {flight.scenario.airframe}", flight.airframe.parameters),
            Layer(flight.name, flight.scenario.parameters),
            Layer("system id", {"MAV_SYS_ID": system_id}),
        )
        if state is not None:
            with suppress(OSError):  # the stores say what is wrong
                state.mkdir(mode=0o700, parents=True, exist_ok=True)  # the signing key will be in it
        parameter_store = keep_parameters(self.parameters, state, self._report)
        self.parameters.put("MAV_SYS_ID", system_id)  # what was kept does not outweigh what was asked for
        plan_store = Store(state, "plan", PLAN_SCHEMA, self._report)
        self.plan = VehiclePlan(
            report=lambda severity, text: self.say(severity, text),
            changed=lambda mission_type: plan_store.put(self.plan.to_document),
        )
        self._load_plan(plan_store)
        self._signing_store = Store(state, "signing", SIGNING_SCHEMA, self._report, private=True)
        self.signing = self._load_signing()
        self._signing_state = SigningState()
        """What the signing store was given last."""
        self._closed = False
        self._stores = (parameter_store, plan_store, self._signing_store)
        self._writing: dict[Work, Store] = {}
        """Taken from the stores, and not known to be written yet."""
        self.shared = Shared(
            self.parameters, self.plan, card=self._card(state), logs=logs, signing=self.signing, trusted=trusted
        )

    def unsaved(self, now_us: int) -> list[Work]:
        """What has to be on the disk soon. `now_us` is wall time. See `mavsitl.keep.Keeping`."""
        if self.signing is not None and not self._closed:
            self._keep_signing(self.signing.unsaved())
        work: list[Work] = []
        for store in self._stores:
            document = store.take(now_us)
            if document is not None:
                self._writing[document] = store
                work.append(document)
        if self.shared.card is not None:
            work += self.shared.card.unsettled()
        return work

    def saved(self, work: Work, error: OSError | None, now_us: int) -> None:
        """What became of what `unsaved` gave."""
        store = self._writing.pop(work, None)
        if store is None:
            if error is not None:
                self.warn(f"memory card: {error.strerror or error}")
            return
        store.written(error, now_us)
        if store is self._signing_store and self.signing is not None and error is None:
            self.signing.saved(self._signing_state)

    def close(self) -> None:
        """What is `unsaved` afterwards is the last there is to write."""
        if self.signing is not None and (self.signing.has_key or self.signing.unsaved() is not None):
            self._keep_signing(self.signing.closing_state())
        self._closed = True

    def _report(self, text: str) -> None:
        self.warn(text)

    def _keep_signing(self, state: SigningState | None) -> None:
        if state is not None:
            self._signing_state = state
            self._signing_store.put({"state": state.to_bytes().hex()})

    def _load_plan(self, store: Store) -> None:
        content = store.load()
        if content:
            try:
                self.plan.load_document(content)
            except PlanError as error:
                store.set_aside(str(error))

    def _load_signing(self) -> Signing | None:
        if self.unix_us is None:
            return None
        unix_us, state = self.unix_us, SigningState()
        content = self._signing_store.load()
        if content:
            try:
                state = SigningState.from_bytes(bytes.fromhex(content["state"]))
            except (KeyError, TypeError, ValueError):
                self._signing_store.set_aside("signing begins without a key")
        signing = Signing(lambda: unix_us() - EPOCH_UNIX_US, state=state)
        signing.policy.mode = SigningMode(int(self.parameters["MAV_SIGN_CFG"]))
        return signing

    def _card(self, state: Path | None) -> Folder | None:
        """The memory card; None without a state folder, or where that cannot be used."""
        if state is None:
            return None
        try:
            return Folder(state / "card", Quota(), settles_later=True)
        except OSError as error:
            self.warn(f"{state / 'card'}: no memory card: {error.strerror or error}")
            return None
