"""glTF packed number by number by its specification, around the four Gaussians of scene_formats."""

import base64
import json
import struct

import numpy as np
import scene_formats as made

KHR = "KHR_gaussian_splatting"
# In glTF's axes: right, up, back
MEANS = np.array(made.MEANS) * (1, -1, -1)
XYZW = np.array([(i, -j, -k, w) for w, i, j, k in made.ROTATIONS])
SCALES = np.exp(made.LOG_SCALES)
OPACITIES = np.array(made.OPACITIES)[:, None]
SH = np.concatenate([np.array([made.dc(colour) for colour in made.COLOURS])[:, None], made.FLIPPED_REST], 1)


def attributes(degree=3):
    """The numbers of all attributes by name, float64."""
    rest = {
        f"{KHR}:SH_DEGREE_{each}_COEF_{index}": SH[:, each * each + index]
        for each in range(degree + 1)
        for index in range(2 * each + 1)
    }
    shape = {f"{KHR}:ROTATION": XYZW, f"{KHR}:SCALE": SCALES, f"{KHR}:OPACITY": OPACITIES}
    return {"POSITION": MEANS, **shape, **rest}


class Gltf:
    """A file in the making: root is its JSON, data its buffer."""

    def __init__(self, **extension):
        self.data = b""
        self.root = {"asset": {"version": "2.0"}, "extensionsUsed": [KHR], "scene": 0, "scenes": [{"nodes": [0]}]}
        self.root |= {"nodes": [{"mesh": 0}], "meshes": [], "accessors": [], "bufferViews": []}
        self.extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", **extension}

    def view(self, content):
        self.root["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)})
        self.data += content.ljust(-(-len(content) // 4) * 4, b"\0")
        return len(self.root["bufferViews"]) - 1

    def accessor(self, numbers, kind="<f4", normalized=False):
        """Add an accessor; normalized: the numbers are fractions of the largest integer of `kind`."""
        numbers = np.asarray(numbers)
        width = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[numbers.shape[1]]
        stored = np.round(numbers * np.iinfo(kind).max) if normalized else numbers
        code = {"<i1": 5120, "<u1": 5121, "<i2": 5122, "<u2": 5123, "<f4": 5126}[kind]
        found = {"bufferView": self.view(stored.astype(kind).tobytes()), "componentType": code, "type": width}
        self.root["accessors"].append({**found, "count": len(numbers), **({"normalized": True} if normalized else {})})
        return len(self.root["accessors"]) - 1

    def gaussians(self, columns=None, **more):
        """Add a mesh of Gaussians with these columns, by name, or indices of accessors."""
        columns = attributes() if columns is None else columns
        used = {name: one if isinstance(one, int) else self.accessor(one) for name, one in columns.items()}
        self.root["meshes"].append(
            {"primitives": [{"mode": 0, "attributes": used, "extensions": {KHR: self.extension}, **more}]}
        )
        return self

    def glb(self):
        self.root["buffers"] = [{"byteLength": len(self.data)}] if self.data else []
        text = json.dumps(self.root).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(self.data), b"BIN\0") + self.data
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def gltf(self, uri=None):
        """The .gltf; uri: of its data, which are inside without one."""
        uri = uri or "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        self.root["buffers"] = [{"byteLength": len(self.data), "uri": uri}]
        return json.dumps(self.root).encode()
