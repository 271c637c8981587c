"""A program around the exported C: it encodes, decodes and talks over a serial line as lines on its stdin ask.

`decode ROW HEX`, `check ROW HEX`, `encode ROW VALUE…`, `frame ID HEX`, `receive DIALECT PENDING HEX`, `open PATH DIALECT`, `ask ID HEX`, and
on CAN `can_frame ID HEX`, `can_receive`, `can CANID HEX`, `can_give_up`, from address 1 to 4; each is answered by one line.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Self

import pytest

from starhil.protocol.export.c import files, prefix_of
from starhil.protocol.export.c.rows import is_single
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Field, Row
from starhil.protocol.icd.quoting import c_member
from starhil.protocol.icd.values import Value
from starhil.protocol.serial.stack import SerialStack
from tests.waiting import PATIENCE_S

WARNINGS = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
FLAGS = [*WARNINGS, "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")

_MAIN = r"""
#define _POSIX_C_SOURCE 200809L
#include "unit.h"

#include <fcntl.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <unistd.h>

static char *word(void)
{
    return strtok(NULL, " \n");
}

static size_t hex(uint8_t *bytes)
{
    const char *text = word();
    size_t size = 0u;
    unsigned byte;
    while (text != NULL && *text != '-' && sscanf(text + 2u * size, "%2x", &byte) == 1) {
        bytes[size++] = (uint8_t)byte;
    }
    return size;
}

static void print_hex(const uint8_t *bytes, size_t size)
{
    size_t i;
    printf(" ");
    for (i = 0u; i < size; ++i) {
        printf("%02x", bytes[i]);
    }
    printf(size == 0u ? "-" : "");
}

static void print_message(const unit_message_t *message)
{
    if (message->kind == UNIT_FAULT) {
        printf("%d 0 0 - ", (int)message->kind);
        return;
    }
    printf("%d %lu %lu", (int)message->kind, (unsigned long)message->id, (unsigned long)message->code);
    print_hex(message->data, message->size);
    printf(" ");
}

static void decode(const char *row, const uint8_t *data, size_t size)
{
    (void)row, (void)data, (void)size;
    @decode@
}

static void check(const char *row, const uint8_t *data, size_t size)
{
    (void)row, (void)data, (void)size;
    @check@
}

static void encode(const char *row)
{
    uint8_t data[4096];
    (void)row, (void)data;
    @encode@
}

static unit_receiver_t receiver;
static int port = -1;

@variant@

static void ask(uint32_t id)
{
    static uint8_t data[4096], frame[UNIT_REQUEST_CAPACITY(4096)];
    unit_message_t message;
    struct pollfd waiting = {port, POLLIN, 0};
    const size_t size = hex(data);
    const size_t length = unit_frame_request(id, data, size, frame, sizeof frame);
    uint8_t byte;
    (void)unit_give_up(&receiver);
    unit_expect(&receiver, id);
    if (length == 0u || write(port, frame, length) != (ssize_t)length) {
        printf("cannot send");
        return;
    }
    while (poll(&waiting, 1u, 5000) > 0 && read(port, &byte, 1u) == 1) {
        if (unit_receive(&receiver, byte, &message) != UNIT_NONE) {
            print_message(&message);
            return;
        }
    }
    printf("no answer");
}

static void open_port(const char *path)
{
    struct termios line;
    port = open(path, O_RDWR | O_NOCTTY);
    memset(&line, 0, sizeof line);
    line.c_cflag = CS8 | CREAD | CLOCAL;
    (void)cfsetispeed(&line, B38400);
    (void)cfsetospeed(&line, B38400);
    @init@(word());
    printf("%d", port < 0 ? -1 : tcsetattr(port, TCSANOW, &line));
}

int main(void)
{
    static char line[20000];
    static uint8_t bytes[8192], frame[20000];
    unit_message_t message;
    size_t size, i;
    while (fgets(line, sizeof line, stdin) != NULL) {
        const char *verb = strtok(line, " \n");
        const char *first = word();
        if (strcmp(verb, "decode") == 0) {
            size = hex(bytes);
            decode(first, bytes, size);
        } else if (strcmp(verb, "check") == 0) {
            size = hex(bytes);
            check(first, bytes, size);
        } else if (strcmp(verb, "encode") == 0) {
            encode(first);
        } else if (strcmp(verb, "frame") == 0) {
            size = hex(bytes);
            const size_t needed = @needed@;
            printf("%d", (int)unit_frame_request((uint32_t)atol(first), bytes, size, frame, needed - 1u));
            print_hex(frame, unit_frame_request((uint32_t)atol(first), bytes, size, frame, needed));
        } else if (strcmp(verb, "receive") == 0) {
            const int pending = atoi(word());
            size = hex(bytes);
            @init@(first);
            if (pending >= 0) {
                unit_expect(&receiver, (uint32_t)pending);
            }
            for (i = 0u; i < size; ++i) {
                if (unit_receive(&receiver, bytes[i], &message) != UNIT_NONE) {
                    print_message(&message);
                }
            }
            printf("%d", (int)unit_give_up(&receiver));
        } else if (strcmp(verb, "open") == 0) {
            open_port(first);
        } else if (strncmp(verb, "can", 3u) == 0) {
            size = hex(bytes);
            on_can(verb, first == NULL ? 0ul : strtoul(first, NULL, 10), bytes, size);
        } else {
            ask((uint32_t)atol(first));
        }
        printf("\n");
        (void)fflush(stdout);
    }
    return 0;
}
"""


_VARIANTS = {
    False: """
static void init_receiver(const char *dialect)
{
    unit_receiver_init(&receiver, (unit_dialect_t)atoi(dialect));
}

static size_t needed_capacity(uint32_t id, const uint8_t *data, size_t size, uint8_t *frame)
{
    return unit_frame_request((uint8_t)id, data, size, frame, UNIT_REQUEST_CAPACITY(size));
}

static void on_can(const char *verb, unsigned long id, const uint8_t *data, size_t size)
{
    static unit_can_receiver_t can_receiver;
    unit_can_frame_t frame;
    unit_message_t message;
    size_t number;
    if (strcmp(verb, "can_frame") == 0) {
        for (number = 0u; unit_can_request((uint8_t)id, data, size, 1u, 4u, number, &frame); ++number) {
            printf("%lu", (unsigned long)frame.id);
            print_hex(frame.data, frame.size);
            printf(" ");
        }
    } else if (strcmp(verb, "can_receive") == 0) {
        unit_can_receiver_init(&can_receiver, 1u, 4u);
    } else if (strcmp(verb, "can_give_up") == 0) {
        printf("%d", (int)unit_can_give_up(&can_receiver));
    } else {
        memset(&frame, 0, sizeof frame);
        frame.id = (uint32_t)id;
        frame.size = (uint8_t)size;
        memcpy(frame.data, data, size);
        if (unit_can_receive(&can_receiver, &frame, &message) != UNIT_NONE) {
            print_message(&message);
        }
    }
}
""",
    True: """
static void init_receiver(const char *dialect)
{
    (void)dialect;
    unit_receiver_init(&receiver);
}

static size_t needed_capacity(uint32_t id, const uint8_t *data, size_t size, uint8_t *frame)
{
    (void)id, (void)data, (void)frame;
    return UNIT_REQUEST_CAPACITY(size);
}

static void on_can(const char *verb, unsigned long id, const uint8_t *data, size_t size)
{
    (void)verb, (void)id, (void)data, (void)size;
}
""",
}
"""The two kinds of links: CubeSpace, with its dialects, and composed links."""


def _printed(field: Field) -> str:
    value = f"values.{c_member(field.name)}"
    if field.kind == "bytes":
        return f"print_hex({value}, sizeof {value});"
    if field.kind == "text":
        return f"print_hex((const uint8_t *){value}, strlen({value}));"
    if field.kind == "float" or field.scaled:
        return f'printf(" %.17g", (double){value});'
    if field.type.startswith("i"):
        return f'printf(" %lld", (long long){value});'
    return f'printf(" %llu", (unsigned long long){value});'


def _read(field: Field) -> str:
    value = f"values.{c_member(field.name)}"
    if field.kind in ("bytes", "text"):
        return f"(void)hex((uint8_t *){value});"
    if field.kind == "flag":
        return f"{value} = atoi(word()) != 0;"
    if field.kind == "float" or field.scaled:
        cast = "(float)" if is_single(field) else ""
        return f"{value} = {cast}strtod(word(), NULL);"
    if field.type.startswith("i"):
        return f"{value} = strtoll(word(), NULL, 10);"
    return f"{value} = strtoull(word(), NULL, 10);"


def _name(row: Row) -> str:
    return f"unit_{'tc' if row.kind == 'telecommand' else 'tlm'}_{row.name}"


def _cases(icd: InterfaceDefinition, body: str, do: Any) -> Iterator[str]:
    for row in icd.rows:
        if row.named_fields:
            steps = " ".join(do(field) for field in row.named_fields.values())
            text = body.replace("NAME", _name(row)).replace("SIZE", str(row.size)).replace("STEPS", steps)
            yield f'if (strcmp(row, "{row.name}") == 0) {{ {_name(row)}_t values; {text} return; }}'


def driver_source(icd: InterfaceDefinition, *, composed: bool) -> str:
    """Return the program for a definition."""
    decode = _cases(
        icd,
        'const int rc = NAME_decode(data, size, &values); printf("%d", rc); if (rc >= 0) { STEPS }',
        _printed,
    )
    encode = _cases(
        icd,
        "memset(&values, 0, sizeof values); STEPS const int rc = NAME_encode(&values, data); "
        'printf("%d", rc); if (rc == 0) { print_hex(data, SIZEu); }',
        _read,
    )
    check = _cases(
        icd,
        '(void)NAME_decode(data, size, &values); printf("%d", NAME_check(&values));',
        lambda _field: "",
    )
    text = (
        _MAIN.replace("@check@", "\n    ".join(check))
        .replace("@decode@", "\n    ".join(decode))
        .replace("@encode@", "\n    ".join(encode))
    )
    text = text.replace("@init@", "init_receiver").replace(
        "@needed@", "needed_capacity((uint32_t)atol(first), bytes, size, frame)"
    )
    text = text.replace("@variant@", _VARIANTS[composed])
    prefix = prefix_of(icd)
    return (
        text.replace("unit_", f"{prefix}_")
        .replace("UNIT_", f"{prefix.upper()}_")
        .replace("unit.h", f"{prefix}.h")
    )


class CDriver:
    """The compiled program of a definition, as a process; a context manager."""

    def __init__(
        self,
        icd: InterfaceDefinition,
        folder: Path,
        stack: SerialStack | None = None,
        flags: Sequence[str] = FLAGS,
    ) -> None:
        if COMPILER is None:
            pytest.skip("no C compiler (cc, gcc or clang) here: the exported C is not compiled")
        stack = stack or SerialStack(icd)
        for name, text in files(icd, stack).items():
            (folder / name).write_text(text)
        (folder / "driver.c").write_text(driver_source(icd, composed=not stack.dialects))
        self._program = folder / "driver"
        sources = [folder / "driver.c", folder / f"{prefix_of(icd)}.c"]
        done = subprocess.run(
            [COMPILER, *flags, "-o", self._program, *sources], capture_output=True, text=True, check=False
        )
        assert (done.returncode, done.stderr) == (0, "")

    def __enter__(self) -> Self:
        self._process = subprocess.Popen(
            [self._program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        return self

    def __exit__(self, *error: object) -> None:
        _, errors = self._process.communicate(timeout=PATIENCE_S)
        assert (self._process.returncode, errors) == (0, "")

    def __call__(self, *words: object) -> list[str]:
        """Send a line and return the words of the answer."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(" ".join(map(str, words)) + "\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            raise AssertionError(self._process.communicate()[1])
        return answer.split()


def hex_or_none(data: bytes) -> str:
    return data.hex() or "-"


class SingleWord(str):
    """A number that the program computes in single precision: equal to another but for the rounding of its operations."""

    __slots__ = ("bias",)
    __hash__ = str.__hash__
    bias: float
    """What the last operation adds."""

    def __eq__(self, other: object) -> bool:
        rounding = 2.0**-22
        near = pytest.approx(float(self), rel=rounding, abs=rounding * abs(self.bias))
        return isinstance(other, str) and float(other) == near

    def __ne__(self, other: object) -> bool:
        return not self == other


def c_words(row: Row, values: dict[str, Value]) -> list[str]:
    """Values as the program reads and prints them."""
    words = []
    for name, field in row.named_fields.items():
        value = values[name]
        if isinstance(value, str | bool) and field.enum is not None:
            value = field.enum.number(value)
        if isinstance(value, bytes | str):
            words.append(hex_or_none(value if isinstance(value, bytes) else value.encode()))
        else:
            fraction = field.scaled or field.kind == "float"
            word = f"{float(value):.17g}" if fraction else str(int(value))
            if field.kind != "float" and is_single(field):
                word = SingleWord(word)
                word.bias = field.bias
            words.append(word)
    return words
