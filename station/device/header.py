"""Writes the generated sources in firmware/core: ``python -m station.device.header``.

protocol.h and protocol.c come from firmware/protocol.toml, states.h and states.c from firmware/states.toml.
"""

from __future__ import annotations

from pathlib import Path

from station.device.firmware import firmware_folder
from station.device.protocol import PROTOCOL, Field, Message, Protocol
from station.device.states import EVENTS, counters

_C_TYPES = {"u8": "uint8_t", "i8": "int8_t", "u16": "uint16_t", "i16": "int16_t", "u32": "uint32_t", "i32": "int32_t"}
_NOTICE = "/* Written by `python -m station.device.header` from firmware/protocol.toml.  Do not edit. */\n"
_STATES_NOTICE = _NOTICE.replace("protocol.toml", "states.toml")
_WORDS = {"refused": "STATION_REFUSED", "foreign": "STATION_FOREIGN", "never": "STATION_NEVER"}


def _constants(protocol: Protocol) -> list[str]:
    lines = ["enum {", f"    STATION_PROTOCOL_VERSION = {protocol.version},"]
    lines += [f"    STATION_{name.upper()} = {value}," for name, value in protocol.limits.items()]
    for message in protocol.messages.values():
        lines.append(f"    STATION_CODE_{message.name.upper()} = 0x{message.code:02x},")
    for message in protocol.messages.values():
        lines.append(f"    STATION_BODY_{message.name.upper()} = {message.body_size},")
    for group, values in protocol.enums.items():
        lines += [f"    STATION_{group.upper()}_{name.upper()} = {value}," for name, value in values.items()]
    for group, bits in protocol.flags.items():
        lines += [f"    STATION_{group.upper()}_{name.upper()} = 0x{1 << bit:04x}," for name, bit in bits.items()]
    return [*lines, "};"]


def _member(field: Field) -> str:
    declared = f"char {field.name}[{field.text_size}]" if field.text_size else f"{_C_TYPES[field.type]} {field.name}"
    note = ", ".join(part for part in (field.unit, field.doc) if part)
    return f"    {declared};" + (f" /* {note} */" if note else "")


def _structures(protocol: Protocol) -> list[str]:
    lines: list[str] = []
    for message in protocol.messages.values():
        if not message.fields:
            continue
        lines += ["", f"/* {message.doc or message.name}; from the {message.sender} */", "typedef struct {"]
        lines += [_member(field) for field in message.fields]
        lines += [f"}} station_{message.name};"]
    return lines


def _prototypes(message: Message) -> tuple[str, str]:
    name = message.name
    return (f"void station_pack_{name}(const station_{name} *in, uint8_t *body)",
            f"void station_unpack_{name}(const uint8_t *body, station_{name} *out)")


def declarations(protocol: Protocol = PROTOCOL) -> str:
    """What a C parser needs to know: constants, structures, functions (also the library's declarations in Python)."""
    lines = [*_constants(protocol), *_structures(protocol), ""]
    for message in protocol.messages.values():
        if message.fields:
            lines += [f"{prototype};" for prototype in _prototypes(message)]
    return "\n".join([*lines, "uint8_t station_body_size(uint8_t code);", ""])


def header(protocol: Protocol = PROTOCOL) -> str:
    """The text of protocol.h."""
    named = " ".join(f"X({message.name})" for message in protocol.messages.values() if message.fields)
    return f"""{_NOTICE}
#ifndef STATION_PROTOCOL_H
#define STATION_PROTOCOL_H

#include <stdint.h>

#define STATION_PROTOCOL_HASH 0x{protocol.hash:08x}u

{declarations(protocol)}
/* Every message that has fields. */
#define STATION_MESSAGES(X) \\
    {named}

#endif
"""


def _pack_line(field: Field, offset: int) -> str:
    if field.text_size:
        return f"    memcpy(body + {offset}, in->{field.name}, {field.text_size});"
    bits = field.type[1:]
    value = f"in->{field.name}" if field.type[0] == "u" else f"(uint{bits}_t)in->{field.name}"
    return f"    put{bits}(body + {offset}, {value});"


def _unpack_line(field: Field, offset: int) -> str:
    if field.text_size:
        return f"    memcpy(out->{field.name}, body + {offset}, {field.text_size});"
    bits = field.type[1:]
    value = f"get{bits}(body + {offset})"
    return f"    out->{field.name} = {value if field.type[0] == 'u' else f'signed{bits}({value})'};"


_HELPERS = """
static void put8(uint8_t *to, uint8_t value) { to[0] = value; }

static void put16(uint8_t *to, uint16_t value)
{
    to[0] = (uint8_t)(value & 0xffu);
    to[1] = (uint8_t)(value >> 8);
}

static void put32(uint8_t *to, uint32_t value)
{
    put16(to, (uint16_t)(value & 0xffffu));
    put16(to + 2, (uint16_t)(value >> 16));
}

static uint8_t get8(const uint8_t *from) { return from[0]; }

static uint16_t get16(const uint8_t *from)
{
    return (uint16_t)(from[0] | ((uint32_t)from[1] << 8));
}

static uint32_t get32(const uint8_t *from)
{
    return get16(from) | ((uint32_t)get16(from + 2) << 16);
}

/* Two's complement without the conversions that C leaves to the compiler. */
static int16_t signed16(uint16_t value)
{
    return (int16_t)(value < 0x8000u ? (int32_t)value : (int32_t)value - 0x10000);
}

static int32_t signed32(uint32_t value)
{
    return value < 0x80000000u ? (int32_t)value : -(int32_t)(0xffffffffu - value) - 1;
}
"""


def source(protocol: Protocol = PROTOCOL) -> str:
    """The text of protocol.c."""
    lines = [_NOTICE, '#include "protocol.h"', "", "#include <string.h>", _HELPERS.rstrip()]
    for message in protocol.messages.values():
        if not message.fields:
            continue
        packs, unpacks = [f"    body[0] = STATION_CODE_{message.name.upper()};"], []
        offset = 1
        for field in message.fields:
            packs.append(_pack_line(field, offset))
            unpacks.append(_unpack_line(field, offset))
            offset += field.text_size or int(field.type[1:]) // 8
        for prototype, body in zip(_prototypes(message), (packs, unpacks), strict=True):
            lines += ["", prototype, "{", *body, "}"]
    lines += ["", "/* Bytes of code and fields; 0: no such message. */", "uint8_t station_body_size(uint8_t code)", "{",
              "    switch (code) {"]
    for message in protocol.messages.values():
        lines.append(f"    case STATION_CODE_{message.name.upper()}: return STATION_BODY_{message.name.upper()};")
    return "\n".join([*lines, "    default: return 0;", "    }", "}", ""])


def states_declarations() -> str:
    """Events, counters and the table's type, as a C parser needs them."""
    events = "".join(f"    STATION_EVENT_{name.upper()},\n" for name in EVENTS)
    counts = "".join(f"    STATION_COUNT_{name.upper()},\n" for name in counters())
    return f"""enum {{
    STATION_STATES = {len(PROTOCOL.enums["state"])},
    STATION_REFUSED = 0xff,
    STATION_FOREIGN = 0xfe,
    STATION_NEVER = 0xfd
}};

enum {{
{events}    STATION_EVENTS
}};

enum {{
    STATION_COUNT_NONE,
{counts}    STATION_COUNTS
}};

typedef struct {{
    uint8_t next;    /* the state after the event, or one of the three words above */
    uint8_t counter; /* STATION_COUNT_... */
    uint8_t fault;   /* set where it leads into fault */
}} station_cell;

extern const station_cell station_cells[STATION_STATES][STATION_EVENTS];
"""


def states_header() -> str:
    """The text of states.h."""
    return f"""{_STATES_NOTICE}
#ifndef STATION_STATES_H
#define STATION_STATES_H

#include <stdint.h>

#include "protocol.h"

{states_declarations()}
void station_fill_statistics(const uint32_t *counts, station_statistics *out);

#endif
"""


def states_source() -> str:
    """The text of states.c."""
    lines = [_STATES_NOTICE, '#include "states.h"', "",
             "const station_cell station_cells[STATION_STATES][STATION_EVENTS] = {"]
    for state in PROTOCOL.enums["state"]:
        lines.append(f"    [STATION_STATE_{state.upper()}] = {{")
        for event in EVENTS.values():
            after = event.cells[state]
            parts = (_WORDS.get(after, f"STATION_STATE_{after.upper()}"),
                     f"STATION_COUNT_{(event.counter_in(state) or 'none').upper()}",
                     f"STATION_FAULT_{(event.fault_in(state) or 'none').upper()}")
            lines.append(f"        [STATION_EVENT_{event.name.upper()}] = {{{', '.join(parts)}}},")
        lines.append("    },")
    lines += ["};", "", "void station_fill_statistics(const uint32_t *counts, station_statistics *out)", "{"]
    lines += [f"    out->{name} = counts[STATION_COUNT_{name.upper()}];" for name in counters()]
    return "\n".join([*lines, "}", ""])


def generated() -> dict[str, str]:
    """File name and text of everything that is written into ``firmware/core``."""
    return {"protocol.h": header(), "protocol.c": source(), "states.h": states_header(), "states.c": states_source()}


def write(folder: Path | None = None) -> None:
    """Write them."""
    for name, text in generated().items():
        ((folder or firmware_folder() / "core") / name).write_text(text, encoding="utf-8", newline="\n")


if __name__ == "__main__":
    write()
