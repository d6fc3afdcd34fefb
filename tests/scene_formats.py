"""Four Gaussians in all formats, packed number by number by the formats' descriptions."""

import gzip
import io
import json
import math
import struct
import zipfile

import numpy as np
from PIL import Image

C0 = 0.28209479177387814
MEANS = [(0.5, -1.25, 2.0), (-0.75, 0.5, 1.0), (1.5, 2.0, -0.25), (0.0, -2.0, 3.0)]
LOG_SCALES = [(-3.0, -2.5, -4.0), (-1.0, -6.0, -2.0), (-5.0, -5.5, -1.5), (-2.25, -3.5, -4.5)]
OPACITIES = [51 / 255, 1.0, 204 / 255, 127 / 255]
COLOURS = [(1.0, 0.2, 0.0), (0.6, 0.4, 0.8), (0.0, 1.0, 0.2), (0.4, 0.4, 0.4)]
# wxyz; each has another largest component
_TURNS = [(0.9, 0.2, -0.3, 0.1), (0.1, -0.8, 0.4, 0.3), (-0.3, 0.2, 0.7, -0.4), (0.2, 0.3, 0.1, -0.9)]
ROTATIONS = [tuple(part / math.hypot(*turn) for part in turn) for turn in _TURNS]
_RANDOM = np.random.default_rng(7)
REST = _RANDOM.integers(-7, 8, (4, 15, 3)) / 8.0  # harmonics above degree 0: to the step of 4 bits
# Harmonics of degree 1 on that change sign where y and z do
_ODD = np.array([1, 1, 0, 1, 0, 0, 1, 0, 1, 0, 1, 1, 0, 1, 0], bool)
REST_4 = np.concatenate([REST, -REST[:, :9]], 1)  # with those of degree 4
FLIPPED_REST = np.where(_ODD[None, :, None], -REST, REST)


def dc(colour):
    return [(part - 0.5) / C0 for part in colour]


def byte(value):
    return min(255, max(0, round(value)))


def three_smallest(wxyz):
    """Return the index of the largest of four, and the others with the sign that makes it positive."""
    index = max(range(4), key=lambda i: abs(wxyz[i]))
    sign = -1 if wxyz[index] < 0 else 1
    return index, [sign * part for i, part in enumerate(wxyz) if i != index]


def spz_attributes(version, degree):
    """Return the six attributes of an .spz, in its axes: right, up, back."""
    positions, turns = b"", b""
    for (x, y, z), (w, i, j, k) in zip(MEANS, ROTATIONS):
        for part in (x, -y, -z):
            positions += struct.pack("<e", part) if version == 1 else struct.pack("<i", round(part * 4096))[:3]
        if version < 3:
            sign = -1 if w < 0 else 1
            turns += bytes(byte(127.5 + 127.5 * sign * part) for part in (i, -j, -k))
        else:
            index, three = three_smallest((i, -j, -k, w))
            word = index
            for part in three:
                word = word << 10 | (part < 0) << 9 | round(abs(part) * math.sqrt(2) * 511)
            turns += struct.pack("<I", word)
    count = (degree + 1) ** 2 - 1
    return [
        positions,
        bytes(byte(opacity * 255) for opacity in OPACITIES),
        bytes(byte((part * 0.15 + 0.5) * 255) for colour in COLOURS for part in dc(colour)),
        bytes(byte((part + 10) * 16) for logs in LOG_SCALES for part in logs),
        turns,
        bytes(byte(part * 128 + 128) for part in FLIPPED_REST[:, :count].ravel()),
    ]


def spz_plain(version, degree=3, count=4, flags=0):
    """Return an .spz of version 1..3 before gzip."""
    return struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, 12, flags, 0) + b"".join(
        spz_attributes(version, degree)
    )


def spz(version, degree=3, count=4, flags=0):
    return gzip.compress(spz_plain(version, degree, count, flags), mtime=0)


def spz4(compress, degree=3, count=4, flags=0, extensions=b""):
    """Return an .spz of version 4; compress: zstd's function."""
    parts = [part for part in spz_attributes(4, degree) if part]
    packed = [compress(part) for part in parts]
    at = 32 + len(extensions)
    header = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, degree, 12, flags, len(parts), at)
    table = b"".join(struct.pack("<QQ", len(small), len(large)) for small, large in zip(packed, parts))
    return header + extensions + table + b"".join(packed)


def splat():
    return b"".join(
        struct.pack("<6f", *mean, *map(math.exp, logs))
        + bytes([*(byte(part * 255) for part in colour), byte(opacity * 255)])
        + bytes(byte(128 + 128 * part) for part in turn)
        for mean, logs, colour, opacity, turn in zip(MEANS, LOG_SCALES, COLOURS, OPACITIES, ROTATIONS)
    )


def ksplat(level, degree=2):
    """Return a .ksplat: level 0 in one section, levels 1 and 2 with a full bucket of 3 and one of 1."""
    count = 3 * ((degree + 1) ** 2 - 1)
    rows, centres = b"", [(0.5, 0.5, 0.5), (0.0, -2.0, 2.5)]
    for index, (mean, logs) in enumerate(zip(MEANS, LOG_SCALES)):
        rest = [
            REST[index, i, channel] for a, b in ((0, 3), (3, 8))[:degree] for channel in range(3) for i in range(a, b)
        ]
        kind = "f" if level == 0 else "e"
        if level == 0:
            rows += struct.pack("<3f", *mean)
        else:
            centre = centres[index // 3]
            rows += struct.pack("<3H", *(round((a - b) / 2.5 * 32767) + 32767 for a, b in zip(mean, centre)))
        rows += struct.pack(f"<7{kind}", *map(math.exp, logs), *ROTATIONS[index])
        rows += bytes([*(byte(part * 255) for part in COLOURS[index]), byte(OPACITIES[index] * 255)])
        rows += bytes(byte((v + 1.5) / 3 * 255) for v in rest) if level == 2 else struct.pack(f"<{count}{kind}", *rest)
    header = struct.pack("<BB2xIIIIH2x3fff", 0, 1, 1, 1, 4, 4, level, 0, 0, 0, -1.5, 1.5).ljust(4096, b"\0")
    buckets = (3, 2, 5.0, 12, 32767, 0, 1, 1) if level else (0, 0, 0.0, 0, 0, 0, 0, 0)
    section = struct.pack("<IIIIfH2xIIIIH", 4, 4, *buckets, degree).ljust(1024, b"\0")
    stored = struct.pack("<I6f", 1, *centres[0], *centres[1]) if level else b""
    return header + section + stored + rows


def compressed_ply(degree=3):
    """Return a compressed .ply of one chunk, with the extremes of its colours."""

    def packed(values, low, high, bits):
        word = 0
        for value, a, b, bit in zip(values, low, high, bits):
            word = word << bit | round((value - a) / (b - a) * ((1 << bit) - 1))
        return word

    def extremes(rows):
        return [min(part) for part in zip(*rows)], [max(part) for part in zip(*rows)]

    names = [f"{end}_{what}{axis}" for what in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
    names += [f"{end}_{axis}" for end in ("min", "max") for axis in "rgb"]
    ends = [extremes(rows) for rows in (MEANS, LOG_SCALES, COLOURS)]
    chunk = struct.pack("<18f", *(value for pair in ends for row in pair for value in row))
    rows, rest = b"", b""
    for index in range(4):
        largest, three = three_smallest(ROTATIONS[index])
        word = largest
        for part in three:
            word = word << 10 | round((part / math.sqrt(2) + 0.5) * 1023)
        colour = packed((*COLOURS[index], OPACITIES[index]), (*ends[2][0], 0), (*ends[2][1], 1), (8, 8, 8, 8))
        position, scale = (packed(r[index], *e, (11, 10, 11)) for r, e in zip((MEANS, LOG_SCALES), ends))
        rows += struct.pack("<4I", position, word, scale, colour)
        rest += bytes(byte((v / 8 + 0.5) * 256 - 0.5) for v in REST_4[index, : (degree + 1) ** 2 - 1].T.ravel())
    count = 3 * ((degree + 1) ** 2 - 1)
    lines = ["ply", "format binary_little_endian 1.0", "comment by hand", "element chunk 1"]
    lines += [f"property float {name}" for name in names] + ["element vertex 4"]
    lines += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    lines += ["element sh 4", *(f"property uchar f_rest_{i}" for i in range(count))] if degree else []
    return "\n".join([*lines, "end_header\n"]).encode() + chunk + rows + rest


def webp(pixels, width):
    """Return a lossless image of rows of RGBA, padded with zeros."""
    rows = -(-len(pixels) // width)
    array = np.zeros((rows * width, 4), np.uint8)
    array[: len(pixels)] = np.array(pixels, np.uint8)
    file = io.BytesIO()
    Image.fromarray(array.reshape(rows, width, 4)).save(file, "webp", lossless=True, exact=True)
    return file.getvalue()


def sog(version=2, bands=3, /, **changes):
    """Return the files of a SOG by name; changes: to meta.json."""
    logs = [[math.copysign(math.log1p(abs(part)), part) for part in mean] for mean in MEANS]
    words = [[round((part + 2) / 4 * 65535) for part in row] for row in logs]
    turns = []
    for turn in ROTATIONS:
        largest, three = three_smallest(turn)
        turns.append([*(byte((part / math.sqrt(2) + 0.5) * 255) for part in three), 252 + largest])
    codes = [-8 + i / 32 for i in range(256)]  # of scales; colours are coded by the same, from -4 on
    colours = [[*(byte((part + 4) * 32) for part in dc(c)), byte(255 * o)] for c, o in zip(COLOURS, OPACITIES)]
    parts = {
        "means": {"mins": [-2, -2, -2], "maxs": [2, 2, 2], "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": codes, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": [-4 + i / 32 for i in range(256)], "files": ["sh0.webp"]},
    }
    each = {0: 0, 1: 3, 2: 8, 3: 15, 4: 24}[bands]
    if bands:
        parts["shN"] = {"count": 4, "bands": bands, "codebook": [-1 + i / 128 for i in range(256)]}
        parts["shN"]["files"] = ["shN_centroids.webp", "shN_labels.webp"]
    scales = [[*(byte((part + 8) * 32) for part in row), 255] for row in LOG_SCALES]
    if version == 1:
        logits = [math.log(min(max(o, 1e-3), 1 - 1e-3) / (1 - min(max(o, 1e-3), 1 - 1e-3))) for o in OPACITIES]
        colours = [[*row[:3], byte((v + 8) / 16 * 255)] for row, v in zip(colours, logits)]
        parts["means"]["shape"] = [4, 3]
        parts["scales"] = {"mins": [-8] * 3, "maxs": [-8 + 255 / 32] * 3, "files": ["scales.webp"]}
        parts["sh0"] = {"mins": [-4] * 3 + [-8], "maxs": [-4 + 255 / 32] * 3 + [8], "files": ["sh0.webp"]}
        if bands:
            files = parts["shN"]["files"]
            parts["shN"] = {"shape": [4, 3 * each], "mins": -1, "maxs": -1 + 255 / 128, "files": files}
        meta = {**parts, **changes}
    else:
        meta = {"version": 2, "count": 4, **parts, **changes}
    files = {
        "meta.json": json.dumps(meta).encode(),
        "means_l.webp": webp([[*(part & 255 for part in row), 255] for row in words], 4),
        "means_u.webp": webp([[*(part >> 8 for part in row), 255] for row in words], 4),
        "scales.webp": webp(scales, 4),
        "quats.webp": webp(turns, 4),
        "sh0.webp": webp(colours, 4),
    }
    if bands:
        entries = np.zeros((64, each, 4), np.uint8)
        entries[:4, :, :3] = np.clip(np.round((REST_4[::-1, :each] + 1) * 128), 0, 255)  # in another order
        files["shN_centroids.webp"] = webp(entries.reshape(-1, 4), 64 * each)
        files["shN_labels.webp"] = webp([[3 - i, 0, 0, 255] for i in range(4)], 4)
    return files


def zipped(files, method=zipfile.ZIP_STORED, prefix=""):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(prefix + name), data, method)
    return file.getvalue()


def written(folder, files):
    folder.mkdir(exist_ok=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return folder


def streamed(folder, **changes):
    """Write a streamed SOG of two levels with an environment; changes: to lod-meta.json."""
    for name in ("0_0", "0_1", "1_0", "env"):
        written(folder / name, sog(2, 3 if name == "0_0" else 1))
    leaves = [
        {"lods": {"0": {"file": 0, "offset": 1, "count": 2}, "1": {"file": 2, "offset": 0, "count": 1}}},
        {"children": [{"lods": {"0": {"file": 1, "offset": 0, "count": 4}}}]},
    ]
    meta = {"lodLevels": 2, "filenames": [f"{name}/meta.json" for name in ("0_0", "0_1", "1_0")]}
    meta |= {"tree": {"children": leaves}, "environment": "env/meta.json", **changes}
    (folder / "lod-meta.json").write_text(json.dumps(meta))
    return folder


def gsplat_png(folder, degree=1):
    """Write four Gaussians as gsplat's PngCompression does."""
    folder.mkdir(exist_ok=True)
    count = (degree + 1) ** 2 - 1
    opacities = np.clip(np.array(OPACITIES), 0.01, 0.99)
    means = np.array(MEANS)
    stored = {
        "means": np.sign(means) * np.log1p(np.abs(means)),
        "scales": np.array(LOG_SCALES),
        "quats": np.array(ROTATIONS),
        "opacities": np.log(opacities / (1 - opacities)),
        "sh0": np.array([dc(colour) for colour in COLOURS])[:, None],
    }
    meta = {}
    for name, values in stored.items():
        flat = values.reshape(4, -1)
        low, high = flat.min(0), flat.max(0)
        fractions = ((flat - low) / (high - low)).reshape(2, 2, -1).squeeze()
        meta[name] = {"shape": list(values.shape), "dtype": "float32", "mins": low.tolist(), "maxs": high.tolist()}
        words = np.round(fractions * 65535).astype(np.uint16)
        parts = {"_l": words & 255, "_u": words >> 8} if name == "means" else {"": np.round(fractions * 255)}
        for end, pixels in parts.items():
            Image.fromarray(pixels.astype(np.uint8)).save(folder / f"{name}{end}.png")
    palette = np.round((REST_4[::-1, :count].reshape(4, -1) + 1) / 2 * 63).astype(np.uint8)
    np.savez_compressed(folder / "shN.npz", centroids=palette, labels=np.array([3, 2, 1, 0], np.uint16))
    meta["shN"] = {"shape": [4, count, 3], "dtype": "float32", "mins": -1.0, "maxs": 1.0, "quantization": 6}
    (folder / "meta.json").write_text(json.dumps(meta))
    return folder
