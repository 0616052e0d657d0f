"""Damage: what disks, other programs and enemies make of a file, drawn from a seeded generator."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import shutil
import struct
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

NUMBERS = (
    "1e308", "-1e308", "1e400", "nan", "inf", "-inf", "9" * 30, "9" * 400, "9" * 5000, "0", "-1", "", "1e-320", "9007199254740993",
    "0x10", "1_000", "\u00b2", "\u0661", "\x00" * 50, "--", "1,5", "1e9", "-0.0", "4294967296", "true", "null", "[", '"',
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1.5, 1e308, -1e308, float("nan"), float("inf"), 10**30, 10**400, 2**53, 2**63, "", "x", "[]",
    "\x00\x1b[31m", "a\nb", "\udc80", [], {}, [[]], [None], {"a": 1}, [1, [2, [3]]], ["x"] * 50, [1e308] * 8, [0] * 1000,
    {"keypoints": {}}, "9" * 400,
)  # fmt: skip
KINDS = (
    "<f8", ">f8", "<f4", "<f2", "<f16", "<i8", "<u8", "|i1", "|u1", "|b1", "<c16", "<U4", "<U99999999", "<U0", "|S5", "|V8", "|O",
    "<M8[D]", "<m8[ns]", "f8,f8", "(1000000,)f8", "a", "", None, 7, [("a", "<f8")], [["a"]], "<f8 ", "x" * 500,
)  # fmt: skip
SIDES = (0, 1, 2, 3, 7, -1, 10**6, 10**9, 10**12, 10**18, 2**63, True, "3", 2.0, None)
EXTREMES = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 2**62, 2**64 - 1)


# ---- bytes ---------------------------------------------------------------------------------------------------------------
def of_bytes(data: bytes, rng: Random) -> bytes:
    """A few bytes flipped, cut off, put in, repeated, or set to numbers at the edge."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 16))):
        at = rng.randrange(len(out) + 1) if rng.random() < 0.6 else rng.randrange(min(len(out), 600) + 1)
        way = rng.randrange(8)
        if way == 0 and at < len(out):
            out[at] ^= 1 << rng.randrange(8)
        elif way == 1 and at < len(out):
            out[at] = rng.choice((0, 0xFF, 0x20, 0x5B, rng.randrange(256)))
        elif way == 2:
            size = rng.choice((1, 2, 4, 8))
            out[at : at + size] = (rng.choice(EXTREMES) % 256**size).to_bytes(size, rng.choice(("little", "big")))
        elif way == 3:
            del out[at : at + rng.choice((1, 4, 100, len(out)))]
        elif way == 4:
            out[at:at] = rng.randbytes(rng.choice((1, 4, 64)))
        elif way == 5:
            out[at:at] = out[at : at + rng.choice((4, 64, 1000))]
        elif way == 6:
            size = rng.choice((4, 32, 512))
            out[at : at + size] = bytes([rng.choice((0, 0xFF))]) * min(size, len(out) - at)
        else:
            other = rng.randrange(len(out) + 1)
            out[at : at + 8], out[other : other + 8] = out[other : other + 8], out[at : at + 8]
    return bytes(out)


# ---- text ----------------------------------------------------------------------------------------------------------------
TOKEN = re.compile(r"-?\d+(?:\.\d+)?(?:e-?\d+)?|[A-Za-z_]\w*")


def of_text(text: str, rng: Random) -> str:
    """A number that is none, a line that is gone or comes twice, a column less, brackets without end."""
    tokens, lines = list(TOKEN.finditer(text)), text.split("\n")
    way = rng.randrange(10)
    if way < 4 and tokens:
        for found in sorted(rng.sample(tokens, min(len(tokens), rng.choice((1, 1, 2, 5)))), key=lambda m: -m.start()):
            new = rng.choice(NUMBERS) if rng.random() < 0.8 else rng.choice(tokens).group()
            text = text[: found.start()] + new + text[found.end() :]
        return text
    at = rng.randrange(len(lines)) if rng.random() < 0.6 else 0
    if way == 4:
        del lines[at]
    elif way == 5:
        lines.insert(at, rng.choice(lines))
    elif way == 6:
        cells = re.split(r"([,;\t ])", lines[at])
        rng.shuffle(cells)
        lines[at] = "".join(cells[: rng.randrange(1, len(cells) + 1)])
    elif way == 7:
        spot = rng.randrange(len(text) + 1)
        junk = ("[" * 200, "{" * 3000, "a." * 3000, '"' * 99, "\x00", "\ufeff", "\r", "x" * 200_000, "," * 30_000, "\ud800")
        return text[:spot] + rng.choice(junk) + text[spot:]
    elif way == 8:
        return text.translate({ord(a): b for a, b in zip(rng.sample(",;.\t\n:", 2), ";,", strict=True)})
    else:
        lines[at] = lines[at][: rng.randrange(len(lines[at]) + 1)]
    return "\n".join(lines)


def of_json(value: Any, rng: Random) -> Any:
    """One value somewhere inside replaced by one of another type, left out, or doubled."""
    parents = []

    def walk(node: Any) -> None:
        if isinstance(node, (dict, list)) and node:
            parents.append(node)
            for child in node.values() if isinstance(node, dict) else node[:40]:
                walk(child)

    walk(value)
    if not parents or rng.random() < 0.02:
        return rng.choice(VALUES)
    # as often near the root, where the structure is, as among thousands of numbers
    parent = rng.choice(parents[:8]) if rng.random() < 0.4 else rng.choice(parents)
    keys = list(parent) if isinstance(parent, dict) else range(len(parent))
    key: Any = rng.choice(keys)
    way = rng.randrange(6)
    if way == 0:
        del parent[key]
    elif way == 1 and isinstance(parent, dict):
        parent[rng.choice(("", "x" * 300, "a\nb", *map(str, NUMBERS[:4])))] = parent.pop(key)
    elif way == 2 and isinstance(parent, list):
        parent.insert(key, parent[key] if rng.random() < 0.5 else rng.choice(VALUES))
    else:
        parent[key] = parent[rng.choice(keys)] if rng.random() < 0.1 else rng.choice(VALUES)
    return value


def dumped(value: Any) -> bytes:
    """JSON, with whatever numbers Python can write."""
    return json.dumps(value).encode("utf-8", "surrogatepass")


# ---- numpy ---------------------------------------------------------------------------------------------------------------
def of_npy(data: bytes, rng: Random) -> bytes:
    """A header that declares something else, or an array with other values."""
    if rng.random() < 0.5:
        with contextlib.suppress(Exception):  # of a type that the shape or the values do not take: bytes, then
            return _saved(_array(np.load(io.BytesIO(data)), rng))
    if data[:6] != b"\x93NUMPY" or rng.random() < 0.2:
        return of_bytes(data, rng)
    length = int.from_bytes(data[8:10], "little")
    text, body = data[10 : 10 + length].decode("latin-1"), data[10 + length :]
    way = rng.randrange(6)
    if way < 2:
        text = re.sub(r"'descr': [^,]+", lambda _: f"'descr': {rng.choice(KINDS)!r}", text)
    elif way < 4:
        shape = tuple(rng.choice(SIDES) for _ in range(rng.choice((0, 1, 2, 3, 3, 40))))
        text = re.sub(r"\([^)]*\)", lambda _: repr(shape), text)
    elif way == 4:
        text = rng.choice(
            ("(" * 5000, "{" * 300, "-" * 9000, "{}", "'a", "[1,2", "\\", "x" * 20_000, "0" * 4000, "__import__('os')", text * 99)
        )
    else:
        text = of_text(text, rng).encode("latin-1", "replace").decode("latin-1")
    head = text.encode("latin-1") + b"\n"
    return data[:6] + bytes([rng.choice((1, 1, 1, 2, 3, 9)), 0]) + (len(head) % 65536).to_bytes(2, "little") + head + body


def _saved(array: Any) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=False)
    return stream.getvalue()


def _array(array: Any, rng: Random) -> Any:
    way = rng.randrange(9)
    if way < 2 and array.size:  # other values
        array = array.copy()
        flat = array.reshape(-1)
        for _ in range(rng.choice((1, 3, flat.size))):
            flat[rng.randrange(flat.size)] = rng.choice((np.nan, np.inf, -np.inf, 1e308, -1e308, 0, -1, 2**53, 1e9, 1e-320, 255))
        return array
    if way == 2:
        return array.astype(rng.choice(("f4", "f2", "f16", "i1", "u8", "b1", "c16", "U3", "S3", "M8[D]", "m8[s]", ">f8", "i4")))
    if way == 3:
        return array.reshape(-1)
    if way == 4:
        return array[..., None] if rng.random() < 0.5 else array[None]
    if way == 5:
        return array.T.copy(order=rng.choice("CF"))
    if way == 6:
        return array[: rng.randrange(len(array) + 1)] if array.ndim else array[None]
    if way == 7:
        return np.array(rng.choice((1.0, [], [[]] * 3, "x", ["a", "b"], range(5), np.zeros((2, 2, 2, 2)).tolist())))
    return np.concatenate([array, array]) if array.ndim else array


def of_npz(data: bytes, rng: Random) -> bytes:
    """A member damaged, left out, doubled, renamed, packed otherwise; a directory that lies."""
    if rng.random() < 0.25:
        return of_bytes(data, rng)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(info.filename, archive.read(info), info.compress_type) for info in archive.infolist()]
    at, way = rng.randrange(len(members)), rng.randrange(9)
    name, body, packing = members[at]
    if way < 4:
        members[at] = (name, of_npy(body, rng), packing)
    elif way == 4:
        del members[at]
    elif way == 5:
        new = rng.choice(("more.npy", "x" * 200 + ".npy", "../up.npy", "text.txt", name, "a\nb.npy", ".npy"))
        members.insert(0, (new, of_npy(body, rng), packing))
    elif way == 6:
        new = rng.choice((name.removesuffix(".npy"), name + "x", name.upper(), "y.npy", "a/y.npy", "x1.npy"))
        members[at] = (new, body, packing)
    elif way == 7:
        members[at] = (name, body, rng.choice((zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA, zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED)))
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of names that come twice
        for name, body, packing in members:
            archive.writestr(name, body, packing, 1)
    out = bytearray(stream.getvalue())
    return bytes(_directory(out, rng)) if way == 8 or rng.random() < 0.15 else bytes(out)


def _directory(out: bytearray, rng: Random) -> bytearray:
    """One field of an entry of the directory (or of the header before the member) at the edge."""
    for mark, fields in (
        (b"PK\x01\x02", (4, 6, 8, 10, 12, 16, 20, 24, 28, 30, 32, 42)),
        (b"PK\x03\x04", (4, 6, 8, 14, 18, 22, 26, 28)),
    ):
        spots = [found.start() for found in re.finditer(re.escape(mark), bytes(out))]
        if spots and rng.random() < 0.7:
            at, size = rng.choice(spots) + rng.choice(fields), rng.choice((2, 4))
            value = rng.choice((*EXTREMES, 9, 12, 14, 93, 99, 2**31)) % 256**size
            out[at : at + size] = value.to_bytes(size, "little")
    return out


# ---- safetensors ---------------------------------------------------------------------------------------------------------
BYTES = {"F64": 8, "I64": 8, "U64": 8, "C64": 8, "F32": 4, "I32": 4, "F16": 2, "BF16": 2, "U8": 1, "I8": 1, "BOOL": 1, "F8_E4M3": 1}
PATTERNS = {
    "F32": [struct.pack("<f", v) for v in (np.nan, np.inf, -np.inf, 3e38, 1e30, 1e9, -1.0, 0.0)],
    "F64": [struct.pack("<d", v) for v in (np.nan, np.inf, 1e308, -1e200, 1e9, -1.0, 0.0)],
    "I64": [struct.pack("<q", v) for v in (-1, 0, 1, 2**40, -(2**63), 99)],
    "BOOL": [b"\x02", b"\x00", b"\xff"],
}


def of_safetensors(data: bytes, rng: Random) -> bytes:
    """A header that declares something else, parameters of other types, numbers at the edge among the weights."""
    length = int.from_bytes(data[:8], "little")
    header, body = json.loads(data[8 : 8 + length]), bytearray(data[8 + length :])
    about = header[rng.choice([name for name in header if name != "__metadata__"])]
    way = rng.randrange(6)
    if way == 0:
        return of_bytes(data, rng)
    if way < 3:
        _weights(body, about, rng)
    elif way == 3:
        _declared(about, rng)
    elif way == 4:
        text = header["__metadata__"]["dyntorch"]
        text = json.dumps(of_json(json.loads(text), rng)) if rng.random() < 0.8 else of_text(text, rng)
        header["__metadata__"]["dyntorch"] = text.encode("utf-8", "replace").decode()
    else:
        header = of_json(header, rng)
    head = json.dumps(header).encode()
    head += b" " * (-len(head) % 8)
    return len(head).to_bytes(8, "little") + head + bytes(body)


def _weights(body: bytearray, about: dict[str, Any], rng: Random) -> None:
    """Other values in a tensor, of its own kind: one, a few, or all."""
    (begin, end), pattern = about["data_offsets"], rng.choice(PATTERNS[about["dtype"]])
    count = (end - begin) // len(pattern)
    if rng.random() < 0.1:
        body[begin:end] = pattern * count
        return
    for at in rng.choices(range(count), k=rng.choice((1, 1, 5, 50))) if count else []:
        body[begin + at * len(pattern) : begin + (at + 1) * len(pattern)] = pattern


def _declared(about: dict[str, Any], rng: Random) -> None:
    """Another type or shape, of as many bytes or not."""
    begin, end = about["data_offsets"]
    about["dtype"] = rng.choice((*BYTES, about["dtype"], about["dtype"]))
    count = (end - begin) // BYTES[about["dtype"]]
    about["shape"] = rng.choice(
        ([count], [1, count], about["shape"][::-1], [*about["shape"], 1], about["shape"], [count // 2, 2], [0])
    )


# ---- files and folders ---------------------------------------------------------------------------------------------------
def mutate(path: Path, rng: Random) -> str:
    """Damage a file, or one of a folder, in place: what was done."""
    if path.is_dir():
        return _folder(path, rng)
    if rng.random() < 0.01:
        return _instead(path, rng)
    data = path.read_bytes()
    way, new = _damaged(path.suffix.lower(), data, rng)
    path.write_bytes(new)
    return way


def _damaged(suffix: str, data: bytes, rng: Random) -> tuple[str, bytes]:
    if rng.random() < 0.01:
        return "another file", rng.choice(
            (b"", b"\n", b" " * 600, b"{}", b"[]", b"PK\x03\x04", b"\x93NUMPY\x01\x00", b"ply\n", b"x,y\n", bytes(2048))
        )
    engine: Callable[[bytes, Random], bytes] | None = {".npy": of_npy, ".npz": of_npz, ".safetensors": of_safetensors}.get(suffix)
    if engine is not None:
        return engine.__name__, engine(data, rng)
    text = suffix in (".json", ".csv", ".txt", ".toml") or data.startswith(b"ply\nformat ascii")
    if suffix == ".json" and rng.random() < 0.6:
        return "of_json", dumped(of_json(json.loads(data), rng))
    if text and rng.random() < 0.7:
        return "of_text", of_text(data.decode("utf-8"), rng).encode("utf-8", "surrogatepass")
    return "of_bytes", of_bytes(data, rng)


def _instead(path: Path, rng: Random) -> str:
    """Something that is no file where a file was."""
    path.unlink()
    ways: dict[str, Callable[[], None]] = {
        "a folder": path.mkdir, "a pipe": lambda: os.mkfifo(path), "a link to itself": lambda: path.symlink_to(path.name),
        "a link to nothing": lambda: path.symlink_to("nowhere"), "a link to a device": lambda: path.symlink_to("/dev/zero"),
    }  # fmt: skip
    way = rng.choice(sorted(ways))
    ways[way]()
    return way


def _folder(path: Path, rng: Random) -> str:
    files = sorted(file for file in path.iterdir() if file.is_file())
    file, way = rng.choice(files), rng.randrange(12)
    if way < 6:
        return mutate(file, rng)
    if way == 6:
        return _instead(file, rng)
    if way == 7:
        file.unlink()
        return "a file less"
    if way == 8:
        new = rng.choice(("x.json", "a_00000000000000000000001.json", "7_keypoints.json", "classes.txt", ".hidden", "\udc80_1.txt"))
        file.rename(path / new)
        return "another name"
    if way == 9:
        shutil.copyfile(file, path / rng.choice(("copy_3.json", "copy_3.txt", "z_9999999999999999.json", "c_-4.txt")))
        return "a file more"
    if way == 10:
        for other in files:
            other.unlink()
        return "an empty folder"
    for other in rng.sample(files, min(3, len(files))):
        mutate(other, rng)
    return "several files"
