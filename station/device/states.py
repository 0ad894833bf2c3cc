"""What a board does in each state, as firmware/states.toml defines it."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field

from station.device.firmware import firmware_folder
from station.device.protocol import PROTOCOL, Protocol

NO_STATE = ("refused", "foreign", "never")
"""What a cell may say in place of the state after the event."""


@dataclass(frozen=True)
class Event:
    """One event: the cell of each state, the counter and the fault of those that name a state."""

    name: str
    cells: Mapping[str, str]
    counter: str = ""
    fault: str = ""
    doc: str = field(default="", compare=False)

    def counter_in(self, state: str) -> str:
        """The counter that the event moves in a state, "" for none."""
        return {"refused": "refused", "foreign": "corrupt", "never": ""}.get(self.cells[state], self.counter)

    def fault_in(self, state: str) -> str:
        """The fault that the event sets in a state, "" for none."""
        return self.fault if self.cells[state] == "fault" and state != "fault" else ""


def counters(protocol: Protocol = PROTOCOL) -> list[str]:
    """The statistics' fields that count, in their order."""
    return [each.name for each in protocol.messages["statistics"].fields if each.type == "u32"]


def read_states(text: str, protocol: Protocol = PROTOCOL) -> dict[str, Event]:
    """Parse the definition; ValueError where it contradicts itself or the protocol."""
    events = {row["name"]: Event(**row) for row in tomllib.loads(text)["event"]}
    states, known = set(protocol.enums["state"]), set(counters(protocol))
    requests = [message.name for message in protocol.messages.values() if message.sender == "host"]
    if list(events)[:len(requests)] != requests:
        raise ValueError("states: the first events must be the host's messages in the order of their codes")
    for event in events.values():
        if set(event.cells) != states or not set(event.cells.values()) <= states | set(NO_STATE):
            raise ValueError(f"states: {event.name}: one cell for each state is wanted")
        if event.counter and event.counter not in known:
            raise ValueError(f"states: {event.name}: the statistics have no counter {event.counter}")
        if any(event.cells[s] == "fault" != s for s in states) != bool(event.fault):
            raise ValueError(f"states: {event.name}: a fault code is wanted just where it leads into fault")
        if event.fault and event.fault not in protocol.enums["fault"]:
            raise ValueError(f"states: {event.name}: the protocol has no fault {event.fault}")
    return events


EVENTS = read_states((firmware_folder() / "states.toml").read_text(encoding="utf-8"))


def markdown() -> str:
    """The table for the docs."""
    states = list(PROTOCOL.enums["state"])
    lines = [f"| event | {' | '.join(states)} | counter | fault | |",
             f"| --- | {' | '.join('---' for _ in states)} | --- | --- | --- |"]
    for event in EVENTS.values():
        cells = " | ".join(event.cells[state] for state in states)
        lines.append(f"| {event.name} | {cells} | {event.counter} | {event.fault} | {event.doc} |")
    return "\n".join([*lines, ""])
