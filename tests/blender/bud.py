#!/usr/bin/env python3
"""Writes bud.glb: what Blender exports for a small model with all that a body can be made from.

An armature with two bones, and a bud that is skinned to it: 0.2 m wide and 0.4 m tall, of two
materials (a green stem below, a red cap above), with texture coordinates, normals and tangents. The
object has custom properties, and its mesh the painted attributes _ANCHOR and _STIFFNESS.

Run it with Python 3. It needs nothing else.
"""

import json
import math
import pathlib
import struct

RINGS, SEGMENTS = 16, 24
WIDE, TALL = 0.1, 0.2  # Half of the width and of the height, m.


def vertex(ring, segment):
    """Position, normal, tangent and texture coordinates on the ellipsoid."""
    polar, around = math.pi * ring / RINGS, 2 * math.pi * segment / SEGMENTS
    # The seam and the poles are closed to the bit, as in a modeler.
    across = 0.0 if ring in (0, RINGS) else math.sin(polar)
    around %= 2 * math.pi
    x, y, z = across * math.cos(around), math.cos(polar), across * math.sin(around)
    normal = [x / WIDE, y / TALL, z / WIDE]
    length = math.sqrt(sum(n * n for n in normal))
    return (
        [WIDE * x, TALL + TALL * y, WIDE * z],
        [n / length for n in normal],
        [math.sin(around), 0.0, -math.cos(around), 1.0],
        [1.0 - segment / SEGMENTS, ring / RINGS],
    )


def primitive(rings):
    """The attributes and the triangles between two rings."""
    vertices = [vertex(r, s) for r in range(rings[0], rings[1] + 1) for s in range(SEGMENTS + 1)]
    positions = [v[0] for v in vertices]
    triangles, row = [], SEGMENTS + 1
    for r in range(rings[1] - rings[0]):
        for s in range(SEGMENTS):
            a, b = r * row + s, (r + 1) * row + s
            if rings[0] + r > 0:
                triangles += [a, a + 1, b + 1]
            if rings[0] + r < RINGS - 1:
                triangles += [a, b + 1, b]
    # Seen from outside, triangles go round against the clock.
    upper = [min(1.0, max(0.0, p[1] / (2 * TALL))) for p in positions]
    return {
        "POSITION": (positions, "VEC3", 5126, "f"),
        "NORMAL": ([v[1] for v in vertices], "VEC3", 5126, "f"),
        "TANGENT": ([v[2] for v in vertices], "VEC4", 5126, "f"),
        "TEXCOORD_0": ([v[3] for v in vertices], "VEC2", 5126, "f"),
        "JOINTS_0": ([[0, 1, 0, 0]] * len(vertices), "VEC4", 5121, "B"),
        "WEIGHTS_0": ([[1.0 - u, u, 0.0, 0.0] for u in upper], "VEC4", 5126, "f"),
        # The lowest tenth is fixed, and the cap is twice as stiff.
        "_ANCHOR": ([1.0 if p[1] < 0.2 * TALL else 0.0 for p in positions], "SCALAR", 5126, "f"),
        "_STIFFNESS": ([2.0 if p[1] > TALL else 1.0 for p in positions], "SCALAR", 5126, "f"),
    }, triangles


def main():
    data, views, accessors = bytearray(), [], []

    def accessor(values, kind, component, letter, target=None):
        flat = [x for value in values for x in (value if isinstance(value, list) else [value])]
        while len(data) % 4:
            data.append(0)
        view = {"buffer": 0, "byteOffset": len(data)}
        data.extend(struct.pack(f"<{len(flat)}{letter}", *flat))
        view["byteLength"] = len(data) - view["byteOffset"]
        if target:
            view["target"] = target
        views.append(view)
        made = {"bufferView": len(views) - 1, "componentType": component, "count": len(values), "type": kind}
        if kind == "VEC3":
            rounded = struct.unpack(f"<{len(flat)}f", struct.pack(f"<{len(flat)}f", *flat))
            made["min"] = [min(rounded[k::3]) for k in range(3)]
            made["max"] = [max(rounded[k::3]) for k in range(3)]
        accessors.append(made)
        return len(accessors) - 1

    primitives = []
    for material, rings in [(0, (RINGS // 2, RINGS)), (1, (0, RINGS // 2))]:
        attributes, triangles = primitive(rings)
        primitives.append({
            "attributes": {name: accessor(*values, target=34962) for name, values in attributes.items()},
            "indices": accessor(triangles, "SCALAR", 5123, "H", target=34963),
            "material": material,
        })
    # The bones are at the ground and at half of the height, and not turned.
    binds = [[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, -y, 0, 1] for y in (0.0, TALL)]
    document = {
        "asset": {"generator": "Written by bud.py as Blender's exporter writes", "version": "2.0"},
        "scene": 0,
        "scenes": [{"name": "Scene", "nodes": [3]}],
        "nodes": [
            {"name": "Bone.001", "translation": [0, TALL, 0]},
            {"name": "Bone", "children": [0]},
            {
                "name": "Bud",
                "mesh": 0,
                "skin": 0,
                "extras": {"stiffness": 20000.0, "density": 400.0, "note": "of the object"},
            },
            {"name": "Armature", "children": [2, 1]},
        ],
        "materials": [
            {
                "name": name,
                "doubleSided": True,
                "pbrMetallicRoughness": {"baseColorFactor": color, "metallicFactor": 0, "roughnessFactor": 0.9},
            }
            for name, color in [("Stem", [0, 0.8, 0, 1]), ("Cap", [0.8, 0, 0, 1])]
        ],
        "meshes": [{"name": "Bud", "primitives": primitives, "extras": {"note": "of the mesh"}}],
        "skins": [{
            "name": "Armature",
            "joints": [1, 0],
            "inverseBindMatrices": accessor([[float(x) for x in m] for m in binds], "MAT4", 5126, "f"),
        }],
        "accessors": accessors,
        "bufferViews": views,
    }
    while len(data) % 4:
        data.append(0)
    document["buffers"] = [{"byteLength": len(data)}]
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    out = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(data))
    out += struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    pathlib.Path(__file__).with_name("bud.glb").write_bytes(out)


main()
