#!/usr/bin/env python3
"""Makes the models of the truth scenes: the Stanford bunny and a posed fox, as .glb files that hold everything.

    python truth_models.py --bunny bunny.obj --fox Fox.gltf --out tests/references/truth

bunny.obj is package/bunny.obj of the npm package bunny 1.0.1, Fox.gltf the one of the PyPI package gradio 6.31.0 (Khronos' sample
with everything embedded). Both are scaled to metres with their lowest point at 0. The fox is skinned here, at one time of its walk, so
that every renderer is given the same triangles; like the glTF specification asks where normals are missing, they are flat. numpy only.
"""

import argparse
import base64
import json
import struct
from pathlib import Path

import numpy as np

FOX_CLIP, FOX_SECONDS, FOX_LENGTH_M = "Walk", 0.3, 1.3
BUNNY_HEIGHT_M = 0.75
COMPONENTS = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Gltf:
    """A .glb, or a .gltf with everything embedded."""

    def __init__(self, path):
        data = Path(path).read_bytes()
        if data[:4] == b"glTF":
            length = struct.unpack("<I", data[12:16])[0]
            self.json = json.loads(data[20 : 20 + length])
            self.binary = data[28 + length :]
        else:
            self.json = json.loads(data)
            self.binary = base64.b64decode(self.json["buffers"][0]["uri"].split(",", 1)[1])

    def accessor(self, index):
        """Rows of an accessor as an array."""
        a = self.json["accessors"][index]
        view = self.json["bufferViews"][a["bufferView"]]
        kind, width = np.dtype(COMPONENTS[a["componentType"]]), WIDTHS[a["type"]]
        start = view.get("byteOffset", 0) + a.get("byteOffset", 0)
        stride = view.get("byteStride", kind.itemsize * width)
        rows = [np.frombuffer(self.binary, kind, width, start + i * stride) for i in range(a["count"])]
        return np.array(rows)

    def image(self, index):
        """The bytes of an image."""
        image = self.json["images"][index]
        if "uri" in image:
            return base64.b64decode(image["uri"].split(",", 1)[1])
        view = self.json["bufferViews"][image["bufferView"]]
        start = view.get("byteOffset", 0)
        return self.binary[start : start + view["byteLength"]]


def write_glb(path, positions, normals, indices, material, uvs=None, png=None, note=""):
    """One mesh with one material as .glb."""
    blob, views, accessors = bytearray(), [], []

    def view(data, target=None):
        blob.extend(b"\0" * (-len(blob) % 4))
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(data), **({"target": target} if target else {})})
        blob.extend(data)
        return len(views) - 1

    def accessor(values, kind, component, target):
        bounds = {"min": values.min(0).tolist(), "max": values.max(0).tolist()} if kind == "VEC3" else {}
        at = view(np.ascontiguousarray(values).tobytes(), target)
        accessors.append({"bufferView": at, "componentType": component, "count": len(values), "type": kind, **bounds})
        return len(accessors) - 1

    attributes = {
        "POSITION": accessor(positions.astype(np.float32), "VEC3", 5126, 34962),
        "NORMAL": accessor(normals.astype(np.float32), "VEC3", 5126, 34962),
    }
    gltf = {"asset": {"version": "2.0", "copyright": note, "generator": "truth_models.py"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
    if uvs is not None:
        attributes["TEXCOORD_0"] = accessor(uvs.astype(np.float32), "VEC2", 5126, 34962)
        gltf["images"] = [{"bufferView": view(png), "mimeType": "image/png"}]
        gltf["textures"] = [{"source": 0, "sampler": 0}]
        gltf["samplers"] = [{}]
        material = {**material, "baseColorTexture": {"index": 0}}
    primitive = {"attributes": attributes, "indices": accessor(indices.astype(np.uint16).ravel(), "SCALAR", 5123, 34963), "material": 0}
    gltf |= {"meshes": [{"primitives": [primitive]}], "materials": [{"pbrMetallicRoughness": material}]}
    blob.extend(b"\0" * (-len(blob) % 4))
    gltf |= {"bufferViews": views, "accessors": accessors, "buffers": [{"byteLength": len(blob)}]}
    text = json.dumps(gltf, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(blob), 0x004E4942) + bytes(blob)
    Path(path).write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def matrix(translation, rotation, scale):
    x, y, z, w = rotation
    turned = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])
    out = np.eye(4)
    out[:3, :3] = turned * np.asarray(scale)
    out[:3, 3] = translation
    return out


def sampled(gltf, sampler, seconds, turns):
    """A channel's value at a time, linearly between its keys."""
    times, values = gltf.accessor(sampler["input"])[:, 0], gltf.accessor(sampler["output"]).astype(float)
    at = int(np.clip(np.searchsorted(times, seconds) - 1, 0, len(times) - 2))
    share = np.clip((seconds - times[at]) / (times[at + 1] - times[at]), 0, 1)
    after = values[at + 1] * (np.sign(values[at] @ values[at + 1]) if turns else 1)
    mixed = values[at] * (1 - share) + after * share
    return mixed / np.linalg.norm(mixed) if turns else mixed


def posed(gltf, clip, seconds):
    """Skinned positions of the only mesh."""
    nodes = [{"translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1], **node} for node in gltf.json["nodes"]]
    animation = next(a for a in gltf.json["animations"] if a["name"] == clip)
    for channel in animation["channels"]:
        target = channel["target"]
        value = sampled(gltf, animation["samplers"][channel["sampler"]], seconds, target["path"] == "rotation")
        nodes[target["node"]][target["path"]] = value
    world = {}

    def visit(at, parent):
        node = nodes[at]
        world[at] = parent @ matrix(node["translation"], node["rotation"], node["scale"])
        for child in node.get("children", []):
            visit(child, world[at])

    for root in gltf.json["scenes"][0]["nodes"]:
        visit(root, np.eye(4))
    skin = gltf.json["skins"][0]
    inverse = gltf.accessor(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    joints = np.array([world[joint] @ inverse[i] for i, joint in enumerate(skin["joints"])])
    attributes = gltf.json["meshes"][0]["primitives"][0]["attributes"]
    positions = gltf.accessor(attributes["POSITION"]).astype(float)
    blend = np.einsum("vk,vkij->vij", gltf.accessor(attributes["WEIGHTS_0"]), joints[gltf.accessor(attributes["JOINTS_0"])])
    moved = np.einsum("vij,vj->vi", blend, np.c_[positions, np.ones(len(positions))])
    return moved[:, :3], gltf.accessor(attributes["TEXCOORD_0"])


def face_normals(corners):
    """Of triangles (n, 3, 3), as long as twice their area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def stand(positions, scale):
    """Scaled, centred over the origin, the lowest point at 0."""
    low, high = positions.min(0), positions.max(0)
    middle = (low + high) / 2
    return (positions - [middle[0], low[1], middle[2]]) * scale


def make_fox(source, out):
    gltf = Gltf(source)
    positions, uvs = posed(gltf, FOX_CLIP, FOX_SECONDS)
    positions = stand(positions, FOX_LENGTH_M / (positions.max(0) - positions.min(0)).max())
    normals = face_normals(positions.reshape(-1, 3, 3))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    material = {"metallicFactor": 0, "roughnessFactor": 0.58}
    indices = np.arange(len(positions))
    write_glb(out, positions, np.repeat(normals, 3, 0), indices, material, uvs, gltf.image(0), gltf.json["asset"]["copyright"])


def make_bunny(source, out):
    lines = [line.split() for line in Path(source).read_text().splitlines()]
    positions = np.array([[float(x) for x in line[1:4]] for line in lines if line[:1] == ["v"]])
    indices = np.array([[int(x.split("/")[0]) - 1 for x in line[1:4]] for line in lines if line[:1] == ["f"]])
    positions = stand(positions, BUNNY_HEIGHT_M / np.ptp(positions[:, 1]))
    normals = np.zeros_like(positions)
    np.add.at(normals, indices.ravel(), np.repeat(face_normals(positions[indices]), 3, 0))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    material = {"baseColorFactor": [0.75, 0.72, 0.68, 1], "metallicFactor": 0, "roughnessFactor": 0.5}
    write_glb(out, positions, normals, indices, material, note="Stanford Computer Graphics Laboratory; npm bunny 1.0.1, public domain")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bunny", required=True)
    parser.add_argument("--fox", required=True)
    parser.add_argument("--out", required=True, type=Path)
    arguments = parser.parse_args()
    make_bunny(arguments.bunny, arguments.out / "bunny.glb")
    make_fox(arguments.fox, arguments.out / "fox.glb")
