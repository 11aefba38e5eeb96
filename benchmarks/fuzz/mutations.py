"""Mutations of files that know the container: text, JSON, TOML, arrays, tables, checkpoints.

`mutated(random, name, content)` changes one file. Half of the mutations change bytes or words and
often break the container; the others take the container apart, change what is inside and put it
together again, so that they reach the code behind the parser.
"""

import functools
import gzip
import io
import json
import math
import pickle
import random
import re
import struct
import tomllib
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np

Random = random.Random

NUMBERS = ("0", "-1", "1e308", "-1e308", "1e999", "nan", "inf", "-inf", "1e-320", "2147483648")
NUMBERS += ("9223372036854775808", "18446744073709551616", "0x1p3", "1_000", "1,5", "١٢", "")
NUMBERS += ("9" * 400, "9" * 5000, "0x" + "f" * 3000, "-0.0", "1e", "1.2.3", "true", '"1"')
"""Numbers as text that readers stumble over."""
WORDS = ("", "\0", "\ufeff", "\x1b[31m", "..", "../../etc/passwd", "a" * 300, "é", "\ud7ff", "'")
WORDS += ('"', "\\", "{}", "%s", "None", "k0_x_mm", "p1_kPa", "c1_kPa", "t_s", "run", "\r", "\t")
"""Texts that readers stumble over."""
VALUES: tuple[Any, ...] = (None, True, False, 0, -1, 1, 3, 255, 65536, 10**6, 10**9, 2**31, 2**63)
VALUES += (-(2**63), 10**30, 10**400, 0.5, -1.5, 1e308, 1e-320, math.nan, math.inf, -math.inf)
VALUES += ("", "x", "a" * 2000, "nan", "\0", "\x1b[2J", "../..", [], {}, [[]], [0], [0.0] * 3)
VALUES += ([1e9] * 3, {"": 0}, {"array": "x"}, {"table": {}}, [None], [[[0]]])
"""Values of JSON that readers stumble over."""
INTEGERS = (0, 1, 255, 2**15, 2**16, 2**24, 2**31 - 1, 2**31, 2**32 - 1)
INTEGERS += (2**40, 2**62, 2**63, 2**64 - 1)
"""Integers to write over bytes, for lengths and offsets in headers."""


def mutated(random: Random, name: str, content: bytes) -> bytes:
    """The content of the file `name` after one to three mutations."""
    suffix = name.rpartition(".")[2]
    kinds = [change_bytes, *KINDS.get(suffix, (change_text,))]
    for number in range(random.choice((1, 1, 1, 2, 3))):
        if number and suffix in FRAGILE:
            kinds = [change_bytes, change_head]
        try:
            content = random.choice(kinds)(random, content)
        except Exception:  # what an earlier mutation broke cannot be taken apart again
            content = change_bytes(random, content)
    return content


@functools.lru_cache(maxsize=64)
def _json_tree(content: bytes) -> Any:
    """The parsed JSON; a change copies what it changes, so that one parse serves many inputs."""
    return json.loads(content)


@functools.lru_cache(maxsize=64)
def _toml_tree(content: bytes) -> dict:
    return tomllib.loads(content.decode())


@functools.lru_cache(maxsize=16)
def _arrays(content: bytes) -> dict[str, np.ndarray]:
    with np.load(io.BytesIO(content)) as file:
        return dict(file)


@functools.lru_cache(maxsize=16)
def _parquet(content: bytes) -> Any:
    import pyarrow.parquet as pq

    return pq.read_table(io.BytesIO(content))


@functools.lru_cache(maxsize=16)
def _checkpoint(content: bytes) -> Any:
    import torch

    return torch.load(io.BytesIO(content), weights_only=True)


@functools.lru_cache(maxsize=16)
def _unpacked(content: bytes) -> bytes:
    return gzip.decompress(content)


def change_bytes(random: Random, content: bytes) -> bytes:
    """One change of bytes: flip, cut, insert, repeat, delete, or an integer written over."""
    data, size = bytearray(content), len(content)
    at = random.randrange(size + 1)
    if random.random() < 0.3:  # headers are at both ends of a file
        at = min(random.choice((random.randrange(64), size - random.randrange(256))), size)
        at = max(at, 0)
    length = int(2 ** random.uniform(0, 10))
    match random.randrange(8):
        case 0:
            for _ in range(random.choice((1, 1, 2, 8))):
                if size:
                    place = min(at + random.randrange(32), size - 1)
                    data[place] ^= 1 << random.randrange(8)
        case 1:
            del data[at:]
        case 2:
            del data[at : at + length]
        case 3:
            data[at:at] = random.randbytes(length)
        case 4:
            data[at:at] = data[at : at + length] * random.choice((1, 2, 50))
        case 5:
            form = random.choice(("<I", ">I", "<Q", ">Q", "<H", "B"))
            value = random.choice(INTEGERS) % (1 << (8 * struct.calcsize(form)))
            data[at : at + struct.calcsize(form)] = struct.pack(form, value)
        case 6:
            data[at : at + length] = bytes(len(data[at : at + length]))
        case _:
            data[at:at] = random.choice(WORDS).encode()
    return bytes(data)


def change_text(random: Random, content: bytes) -> bytes:
    """One change of words or lines of a text."""
    text = content.decode("utf-8", "replace")
    lines = text.split("\n")
    row = random.randrange(len(lines))
    match random.randrange(11):
        case 0 | 1 | 2:
            return _replaced(random, text, r"[-+]?\d[\d.eE+-]*", NUMBERS).encode()
        case 3 | 4:
            return _replaced(random, text, r"[A-Za-z_]\w*", WORDS).encode()
        case 5:
            del lines[row]
        case 6:
            lines.insert(row, lines[random.randrange(len(lines))])
        case 7:
            other = random.randrange(len(lines))
            lines[row], lines[other] = lines[other], lines[row]
        case 8:
            deep = random.choice((50, 2000, 30_000))
            opening = random.choice(("[", "{a=", '{"a":', "[[", "a.", '"', "((", "- "))
            lines[row] += opening * deep
        case 9:
            place = random.randrange(len(lines[row]) + 1)
            word = random.choice((*WORDS, " " * 50_000, "x" * 200_000, ",," * 20_000))
            lines[row] = lines[row][:place] + word + lines[row][place:]
        case _:
            mark = random.choice((",", "=", "[", "]", ".", '"', ";", "\n", " "))
            text = text.replace(mark, random.choice((",", ";", "", "\t", '"', mark * 2)), 3)
            return text.encode("utf-8", "replace")
    return "\n".join(lines).encode("utf-8", "replace")


def _replaced(random: Random, text: str, pattern: str, words: tuple[str, ...]) -> str:
    found = list(re.finditer(pattern, text))
    if not found:
        return text + random.choice(words)
    one = random.choice(found)
    return text[: one.start()] + random.choice(words) + text[one.end() :]


def change_tree(random: Random, value: Any, values: tuple[Any, ...] = VALUES) -> Any:
    """A copy of nested dicts and lists in which one node is replaced, removed, added or moved."""
    if isinstance(value, dict) and value and random.random() < 0.85:
        key = random.choice(list(value))
        copy = dict(value)
        match random.randrange(8):
            case 0:
                del copy[key]
            case 1:
                copy[random.choice(WORDS) or "new"] = copy.pop(key)
            case 2:
                copy[random.choice(list(copy))] = copy[key]
            case _:
                copy[key] = change_tree(random, copy[key], values)
        return copy
    if isinstance(value, list | tuple) and value and random.random() < 0.7:
        copy = list(value)
        at = random.randrange(len(copy))
        match random.randrange(6):
            case 0:
                del copy[at]
            case 1:
                copy *= random.choice((2, 30))
            case _:
                copy[at] = change_tree(random, copy[at], values)
        return type(value)(copy)
    return random.choice(values)


def change_json(random: Random, content: bytes) -> bytes:
    """A change of one node of a JSON file."""
    return json.dumps(change_tree(random, _json_tree(content))).encode()


def change_json_lines(random: Random, content: bytes) -> bytes:
    """A change of one node in one line of a file of JSON objects."""
    lines = content.splitlines()
    row = random.choice((0, random.randrange(len(lines))))
    lines[row] = change_json(random, lines[row])
    return b"\n".join(lines) + b"\n"


def change_toml(random: Random, content: bytes) -> bytes:
    """A change of one node of a TOML file."""
    import tomli_w

    values = tuple(v for v in VALUES if v is not None)
    return tomli_w.dumps(change_tree(random, _toml_tree(content), values)).encode()


DTYPES = ("f4", "f8", "i4", "i8", "u1", "?", "c16", "f2", "U4", "S3", "M8[s]", ">f8")
"""Types that an array may be converted to."""


def change_array(random: Random, array: np.ndarray) -> np.ndarray:
    """An array of other values, shape or type."""
    array = np.array(array)
    match random.randrange(9):
        case 0 | 1:
            if array.size and array.dtype.kind in "fiu":
                flat = array.reshape(-1)
                some = slice(None) if random.random() < 0.2 else random.randrange(array.size)
                if array.dtype.kind == "f":
                    flat[some] = random.choice((np.nan, np.inf, -np.inf, 1e30, -1e38, 0.0))
                else:
                    info = np.iinfo(array.dtype)
                    flat[some] = random.choice((info.min, info.max, 0, 1))
        case 2:
            array = array[: random.randrange(len(array) + 1)] if array.ndim else array
        case 3:
            array = array[..., : random.randrange(array.shape[-1] + 1)] if array.ndim else array
        case 4:
            with np.errstate(all="ignore"):
                array = array.astype(random.choice(DTYPES))
        case 5:
            array = array.reshape(-1)
        case 6:
            array = array[None]
        case 7:
            array = np.concatenate([array, array]) if array.ndim else array
        case _:
            array = np.zeros(random.choice(((), (0,), (1,), (3,), (0, 3), (2, 2, 2, 2))))
    return array


def change_npz(random: Random, content: bytes) -> bytes:
    """An .npz file with an array changed, lost, exchanged, or with a false header."""
    arrays = dict(_arrays(content))
    names = list(arrays)
    name = random.choice(names)
    claims: dict[str, bytes] = {}
    match random.randrange(8):
        case 0:
            del arrays[name]
        case 1:
            arrays[name] = arrays[random.choice(names)]
        case 2:
            shape = random.choice(((10**12,), (10**6, 10**6), (2**31, 3), (-1,), (2**62, 2)))
            head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117)
            claims[name] = b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + head.encode() + b"\n"
        case 3 if "table" in arrays:
            table = json.loads(arrays["table"].tobytes())
            text = json.dumps(change_tree(random, table)).encode()
            arrays["table"] = np.frombuffer(text, np.uint8)
        case _:
            arrays[name] = change_array(random, arrays[name])
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as file:
        for key, array in arrays.items():
            part = io.BytesIO()
            np.save(part, array)
            file.writestr(f"{key}.npy", claims.get(key, part.getvalue()))
    return out.getvalue()


def change_safetensors(random: Random, content: bytes) -> bytes:
    """A safetensors file with other tensors, or with a header that is wrong about them."""
    length = struct.unpack("<Q", content[:8])[0]
    header, body = json.loads(content[8 : 8 + length]), content[8 + length :]
    if random.random() < 0.5:
        text = json.dumps(change_tree(random, header)).encode()
        return struct.pack("<Q", len(text)) + text + body
    from safetensors.numpy import load, save

    arrays = load(content)
    name = random.choice(list(arrays))
    if random.random() < 0.2:
        del arrays[name]
    else:
        arrays[name] = np.ascontiguousarray(change_array(random, arrays[name]))
    return save(arrays)


def change_parquet(random: Random, content: bytes) -> bytes:
    """A Parquet file with a column changed, lost, renamed or of another type."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = _parquet(content)
    at = random.randrange(table.num_columns)
    name, column = table.column_names[at], table.column(at)
    match random.randrange(7):
        case 0:
            table = table.remove_column(at)
        case 1:
            names = list(table.column_names)
            names[at] = random.choice((*WORDS, random.choice(names)))
            table = table.rename_columns(names)
        case 2:
            kind = random.choice((pa.string(), pa.int8(), pa.bool_(), pa.float16(), pa.date32()))
            table = table.set_column(at, name, pa.nulls(len(column), kind))
        case 3:
            values = [random.choice(VALUES[:12]) for _ in range(len(column))]
            table = table.set_column(at, name, pa.array([str(v) for v in values]))
        case 4:
            table = table.set_column(at, name, pa.array([[0.0]] * len(column)))
        case 5:
            table = table.slice(random.randrange(len(column) + 1), random.randrange(5))
        case _:
            array = change_array(random, np.array(column.to_numpy())).reshape(-1)
            array = np.resize(array, len(column)) if array.size else np.zeros(len(column))
            table = table.set_column(at, name, pa.array(array))
    out = io.BytesIO()
    pq.write_table(table, out)
    return out.getvalue()


def change_checkpoint(random: Random, content: bytes) -> bytes:
    """A PyTorch checkpoint with another node in its tree, or with another member of its archive."""
    import torch

    if random.random() < 0.6:
        tensors = (torch.zeros(()), torch.zeros(2, 3), torch.full((4,), math.nan))
        out = io.BytesIO()
        tree = _checkpoint(content)
        torch.save(_change_tensors(random, tree, (*VALUES, *tensors)), out)
        return out.getvalue()
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(out, "w") as new:
        names = old.namelist()
        chosen = random.choice([n for n in names if n.endswith("data.pkl")] * 3 + names)
        for name in names:
            part = old.read(name)
            if name == chosen:
                part = change_bytes(random, part) if part and random.random() < 0.9 else b""
                if name.endswith("data.pkl") and random.random() < 0.05:
                    part = pickle.dumps(random.choice(VALUES), protocol=2)
            new.writestr(name, part)
    return out.getvalue()


def _change_tensors(random: Random, tree: Any, values: tuple[Any, ...]) -> Any:
    """`change_tree` where a tensor that is met may get other values, shape or type."""
    import torch

    path, node = [], tree
    while isinstance(node, dict | list | tuple) and len(node) and random.random() < 0.93:
        keys = list(node) if isinstance(node, dict) else range(len(node))
        path.append(random.choice(list(keys)))
        node = node[path[-1]]
    if isinstance(node, torch.Tensor) and random.random() < 0.7:
        new: Any = torch.from_numpy(np.array(change_array(random, node.detach().numpy())))
    else:
        new = change_tree(random, node, values)
    return _put(tree, path, new)


def _put(tree: Any, path: list, new: Any) -> Any:
    if not path:
        return new
    if isinstance(tree, dict):
        return type(tree)({**tree, path[0]: _put(tree[path[0]], path[1:], new)})
    copy = list(tree)
    copy[path[0]] = _put(copy[path[0]], path[1:], new)
    return type(tree)(copy)


def change_gzip(random: Random, content: bytes) -> bytes:
    """A gzip file with other content in it, or one that unpacks to a gigabyte."""
    if random.random() < 0.0005:
        return _bomb()
    inside = _unpacked(content)
    change = change_text if inside[:64].isascii() and b"\0" not in inside[:64] else change_head
    return gzip.compress(change(random, inside), 1)


@functools.cache
def _bomb() -> bytes:
    return gzip.compress(bytes(1 << 30), 1)


def change_head(random: Random, content: bytes) -> bytes:
    """An integer, a real number or a flipped bit in the first 2,048 bytes, where headers are."""
    data = bytearray(content)
    at = random.randrange(min(len(data), random.choice((64, 512, 2048))) or 1)
    form = random.choice(("B", "B", "<H", "<H", "<I", "<Q", "<f", "<d", ">I"))
    value: Any = random.choice(INTEGERS) % (1 << min(8 * struct.calcsize(form), 64))
    if form in ("<f", "<d"):
        value = random.choice((0.0, -1.0, 1e30, math.nan, math.inf))
    if random.random() < 0.3 and data:
        data[at] ^= 1 << random.randrange(8)
    else:
        data[at : at + struct.calcsize(form)] = struct.pack(form, value)
    return bytes(data)


def change_matlab(random: Random, content: bytes) -> bytes:
    """A MATLAB file with a variable changed, lost, exchanged or of another kind."""
    from scipy.io import savemat

    fields = dict(_matlab(content))
    name = random.choice(list(fields))
    match random.randrange(6):
        case 0:
            del fields[name]
        case 1:
            fields[name] = fields[random.choice(list(fields))]
        case 2:
            fields[name] = random.choice(("x", {"a": [1.0]}, np.array([], float), [[1], "x"]))
        case 3 if isinstance(fields[name], dict):
            inner = dict(fields[name])
            key = random.choice(list(inner))
            fields[name] = inner | {key: change_array(random, inner[key])}
        case _:
            fields[name] = change_array(random, fields[name])
    out = io.BytesIO()
    savemat(out, fields, do_compression=random.random() < 0.5)
    return out.getvalue()


@functools.lru_cache(maxsize=16)
def _matlab(content: bytes) -> dict[str, Any]:
    from scipy.io import loadmat

    found = loadmat(io.BytesIO(content), simplify_cells=True)
    return {name: value for name, value in found.items() if not name.startswith("__")}


def change_hdf5(random: Random, content: bytes) -> bytes:
    """An HDF5 file with a dataset changed, lost, or one that claims more than the file holds."""
    import h5py

    out = io.BytesIO(content)
    with h5py.File(out, "r+") as file:
        names: list[str] = []
        file.visititems(lambda name, item: names.append(name) if item.name else None)
        sets = [name for name in names if isinstance(file[name], h5py.Dataset)]
        name = random.choice(sets)
        values = file[name][()]
        del file[name]
        match random.randrange(8):
            case 0:
                pass
            case 1:
                shape = random.choice(((10**9,), (10**6, 10**6), (2**40,), (0,)))
                file.create_dataset(name, shape, "f8", chunks=True, maxshape=(None,) * len(shape))
            case 2:
                file[name] = random.choice((np.array(["a"], object), 1.0, h5py.Empty("f8")))
            case 3:
                file[name] = h5py.SoftLink(random.choice(("/", "/none", f"/{name}", "/t")))
            case 4:
                file[name] = h5py.ExternalLink("raw.h5", random.choice(("/", name)))
            case 5:
                file.create_group(f"{name}/{random.choice(('a', 'b.c', '0'))}")
            case _:
                plain = values if not values.dtype.names else values[values.dtype.names[0]]
                file[name] = change_array(random, plain)
    return out.getvalue()


def change_mcap(random: Random, content: bytes) -> bytes:
    """An MCAP file with a record changed, lost, twice or with another length."""
    at, records = 8, []
    while at + 9 <= len(content) - 8:
        (size,) = struct.unpack_from("<Q", content, at + 1)
        records.append(content[at : at + 9 + size])
        at += 9 + size
    number = random.randrange(len(records))
    record = records[number]
    match random.randrange(6):
        case 0:
            del records[number]
        case 1:
            records.insert(number, records[random.randrange(len(records))])
        case 2:
            records[number] = record[:1] + struct.pack("<Q", random.choice(INTEGERS)) + record[9:]
        case 3:
            records[number] = bytes([random.randrange(16)]) + record[1:]
        case _:
            inside = random.choice((change_bytes, change_head))(random, record[9:])
            records[number] = record[:1] + struct.pack("<Q", len(inside)) + inside
    return content[:8] + b"".join(records) + content[-8:]


def change_nrrd(random: Random, content: bytes) -> bytes:
    """An NRRD file with a change in the text of its header."""
    head, gap, body = content.partition(b"\n\n")
    return change_text(random, head) + gap + body


FRAGILE = ("mat", "h5")
"""Files whose libraries may end the process: what one mutation made is not taken apart again."""
Mutation = Callable[[Random, bytes], bytes]

KINDS: dict[str, tuple[Mutation, ...]] = {
    "json": (change_text, change_json, change_json, change_json),
    "jsonl": (change_text, change_json_lines, change_json_lines, change_json_lines),
    "toml": (change_text, change_text, change_toml, change_toml),
    "npz": (change_npz, change_npz, change_npz),
    "safetensors": (change_safetensors, change_safetensors),
    "parquet": (change_parquet, change_parquet),
    "pt": (change_checkpoint, change_checkpoint, change_checkpoint),
    "gz": (change_gzip, change_gzip),
    "mat": (change_head, change_matlab, change_matlab),
    "h5": (change_head, change_hdf5, change_hdf5),
    "mcap": (change_mcap, change_mcap),
    "nrrd": (change_nrrd, change_nrrd, change_nrrd),
    **dict.fromkeys(("c3d", "nii", "bin", "db3"), (change_head, change_head)),
    **dict.fromkeys(("stl", "rrd", "glb", "field"), ()),
    **dict.fromkeys(("csv", "txt", "obj", "off", "ply"), (change_text, change_text)),
}
"""Mutations of a kind of file by its suffix, beside changes of bytes."""
