"""Bytes that must never change under one version of the format; FORMAT.md says what they are.

A test that fails here means that this software no longer reads what an earlier one wrote: see `tests.golden`.
"""

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import msgpack
import pytest

from fleet_seif import delta_wire, envelope, information, map_wire, merge_records, messages, node_wire, wire
from fleet_seif.envelope import DIGEST_END, SIGNATURE, authenticate, body_digest
from fleet_seif.streams import EMPTY_PREFIX, extend_prefix
from tests import golden
from tests.golden import EXAMPLES, FOLDER, KINDS, RING

SIZE_MAX = 200_000
FORMAT = (Path(envelope.__file__).parent / "FORMAT.md").read_text()
LIMITS = {
    name: getattr(module, name)
    for module in (messages, node_wire, map_wire, merge_records, wire, information, delta_wire, envelope)
    for name in dir(module)
    if name.endswith("_MAX") or name in ("PIECE_BYTES", "VARIANCE_MIN")
}


def read(name: str) -> tuple[bytes, Any]:
    return (FOLDER / f"{name}.bin").read_bytes(), json.loads((FOLDER / f"{name}.json").read_text())


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_bytes_of_a_golden_message_say_what_its_twin_says(name: str) -> None:
    data, _ = read(name)
    assert golden.json_of(name, data) == (FOLDER / f"{name}.json").read_text()


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_record_in_a_twin_is_written_as_the_golden_bytes(name: str) -> None:
    data, twin = read(name)
    kind = golden.kind_of(name)
    record = golden.from_json(kind.record, twin["record"])
    assert kind.encode(record, EXAMPLES[name][1]) == data


def test_the_files_are_those_of_the_examples_and_small() -> None:
    """Otherwise `python -m tests.golden --rewrite`, and the format has changed."""
    assert {path.name for path in FOLDER.iterdir()} == {f"{name}.{end}" for name in EXAMPLES for end in ("bin", "json")}
    assert sum(path.stat().st_size for path in FOLDER.iterdir()) < SIZE_MAX
    assert all(golden.encoded(name) == read(name)[0] for name in EXAMPLES)


def test_every_kind_has_an_ordinary_and_an_edge_message_signed_and_unsigned() -> None:
    for kind in KINDS:
        mine = [name for name in EXAMPLES if name.split("-")[0] == kind]
        assert len(mine) >= 2, kind
        assert {read(name)[0][4] for name in mine} == {KINDS[kind].number}
    signed = {EXAMPLES[name][0].__class__ for name in EXAMPLES if EXAMPLES[name][1] is not None}
    assert len(signed) == 9, "all but pieces and evidence"


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_golden_signature_is_that_of_its_signer_over_the_digest(name: str) -> None:
    data, by = read(name)[0], EXAMPLES[name][1]
    if by is None:
        assert data[DIGEST_END] == 0
        return
    authenticate(data, RING, by.role, by.name)
    signature = data[DIGEST_END + 1 : DIGEST_END + 1 + SIGNATURE]
    assert RING.verify(by.role, by.name, b"fleet_seif signature\0" + data[:DIGEST_END], signature)


# FORMAT.md itself.


def section(title: str) -> str:
    return FORMAT.split(title, 1)[1].split("\n#", 1)[0]


def test_the_worked_message_in_the_format_is_the_golden_one() -> None:
    lines = re.findall(r"^    ((?:[0-9a-f]{2} *)+)(?:\s|$)", section("### 6.15 A whole message"), re.MULTILINE)
    data, _ = read("delta-step")
    assert bytes.fromhex("".join(lines)) == data
    assert f"{len(data)} bytes" in section("### 6.15 A whole message")


def test_the_worked_delta_in_the_format_is_that_of_the_golden_message() -> None:
    lines = re.findall(r"^    .*  ((?:[0-9a-f]{2} )*[0-9a-f]{2})$", section("## 5 Frame delta"), re.MULTILINE)
    variables, blocks, *H, b = [bytes.fromhex(line) for line in lines]
    assert (variables, blocks, b"".join(H), b) == delta_wire.pack_delta(golden.STEP)


def test_the_worked_prefix_digest_is_right() -> None:
    data, _ = read("delta-step")
    chained = extend_prefix(EMPTY_PREFIX, body_digest(data))
    assert chained == hashlib.blake2b(bytes(32) + data[5:37], digest_size=32).digest()
    assert chained.hex() in section("### 7.1 Prefix digest")


def number(text: str) -> float:
    """16 MiB, 2^20, 2^31 - 1, 48,000, 1e9: what tables of limits hold."""
    text = text.replace(",", "").replace("MiB", "* 2^20").replace("^", "**")
    assert re.fullmatch(r"[0-9e*\- ]+", text), text
    return float(eval(text))  # arithmetic of the table, as the line above has made sure


def test_the_limits_in_the_format_are_those_of_the_code() -> None:
    rows = re.findall(r"^\| `([A-Z_]+)` \| ([^|]+) \|", section("## 3 Limits"), re.MULTILINE)
    assert len(rows) >= 15
    for name, value in rows:
        assert number(value.strip()) == LIMITS[name], name


FIELD_COUNTS = {"delta": 16, "heartbeat": 8, "ack": 7, "range": 6, "snapshot": 3, "piece": 5, "map": 7,
                "event": 5, "status": 4, "evidence": 2, "merges": 4}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_the_format_lists_every_field_of_a_kind(kind: str) -> None:
    heading = re.search(rf"^### 6\.\d+ .*\(kind {KINDS[kind].number}\), (\d+) fields$", FORMAT, re.MULTILINE)
    assert heading is not None, kind
    listed = re.findall(r"^\| (\d+) \|", section(heading.group()), re.MULTILINE)
    for name in EXAMPLES:
        if name.split("-")[0] == kind:
            data = read(name)[0]
            start = DIGEST_END + 1 + (SIGNATURE if data[DIGEST_END] else 0)
            body = msgpack.unpackb(data[start:])
            assert len(body) == int(heading[1]) == len(listed) == FIELD_COUNTS[kind]
