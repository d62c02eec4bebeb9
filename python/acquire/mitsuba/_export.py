"""Files of a bake: textures, and a small scene for Mitsuba, glTF and Blender."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np

from .. import InputError, __version__

if TYPE_CHECKING:
    from ._bake import Baked

_SCENE = """<scene version="3.0.0">
    <integrator type="path"/>
    <sensor type="perspective"><float name="fov" value="35"/>
        <transform name="to_world"><lookat origin="{eye}" target="{middle}" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="512"/><integer name="height" value="512"/></film>
    </sensor>
    <shape type="ply"><string name="filename" value="mesh.ply"/>
        <emitter type="area">
            <texture type="bitmap" name="radiance"><string name="filename" value="radiance.exr"/><boolean name="raw" value="true"/></texture>
        </emitter>
        <bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>
    </shape>
</scene>
"""

_BLENDER = '''"""In Blender: blender --python blender.py. The mesh glows with its exitance; Cycles needs no light."""
import os
import bpy

here = os.path.dirname(os.path.abspath(__file__))
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.ply_import(filepath=os.path.join(here, "mesh.ply"), forward_axis="Y", up_axis="Z")
slab = bpy.context.object
# Row 0 of the picture is at v = 0; Blender has it at v = 1.
for loop in slab.data.uv_layers.active.data:
    loop.uv[1] = 1 - loop.uv[1]
material = bpy.data.materials.new("exitance")
material.use_nodes = True
nodes, links = material.node_tree.nodes, material.node_tree.links
nodes.clear()
image, glow, out = nodes.new("ShaderNodeTexImage"), nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeOutputMaterial")
image.image = bpy.data.images.load(os.path.join(here, "radiance.exr"))
image.image.colorspace_settings.name = "Non-Color"
links.new(image.outputs["Color"], glow.inputs["Color"])
links.new(glow.outputs["Emission"], out.inputs["Surface"])
slab.data.materials.clear()
slab.data.materials.append(material)
bpy.context.scene.render.engine = "CYCLES"
bpy.context.scene.view_settings.view_transform = "Standard"
'''


def _take_folder(folder: Path, force: bool) -> None:
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: expected a folder, found a file", "Exists")
    if folder.is_dir() and any(folder.iterdir()):
        if not (folder / "bake.json").is_file():
            raise InputError(f"{folder}: expected an empty folder or an earlier bake, found other files", "Exists")
        if not force:
            raise InputError(f"{folder}: has an earlier bake; force=True replaces it", "Exists")
    folder.mkdir(parents=True, exist_ok=True)


def write_all(folder: Path, mesh: mi.Mesh, slab: Any, baked: Baked, force: bool) -> None:
    """Writes a bake; ``bake.json`` tells what made it."""
    _take_folder(folder, force)
    radiance = baked.exitance / np.float32(np.pi)
    told = {"acquire": __version__, "material": slab.filename, "mm_per_uv": slab.mm_per_uv, "wrap": slab.factors.wrap, "size": len(radiance)}
    (folder / "bake.json").write_text(json.dumps(told, indent=1) + "\n")
    for name, image in (("exitance", baked.exitance), ("radiance", radiance), ("albedo", baked.albedo), ("irradiance", baked.irradiance)):
        mi.Bitmap(image).write(str(folder / f"{name}.exr"))
    _png(folder / "albedo.png", baked.albedo)
    mesh.write_ply(str(folder / "mesh.ply"))
    box = mesh.bbox()
    middle, away = np.array(box.center()).ravel(), float(np.linalg.norm(np.array(box.extents()).ravel()))
    words = lambda p: ", ".join(f"{v:.6g}" for v in p)  # noqa: E731
    (folder / "scene.xml").write_text(_SCENE.format(eye=words(middle + np.array([0.3, 0.4, 1.6]) * away), middle=words(middle)))
    (folder / "blender.py").write_text(_BLENDER)
    strength = float(radiance.max())
    _png(folder / "radiance.png", radiance / max(strength, 1e-30))
    (folder / "slab.glb").write_bytes(_glb(mesh, (folder / "radiance.png").read_bytes(), strength))


def _png(path: Path, image: np.ndarray) -> None:
    """sRGB, 8 bits."""
    mi.Bitmap(np.clip(image, 0, 1).astype(np.float32)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True).write(str(path))


def _glb(mesh: mi.Mesh, png: bytes, strength: float) -> bytes:
    """Binary glTF 2.0 of a mesh that glows: emission is ``strength`` times the picture."""
    places = np.array(mesh.vertex_positions_buffer(), dtype="<f4").reshape(-1, 3)
    uv = np.array(mesh.vertex_texcoords_buffer(), dtype="<f4").reshape(-1, 2)
    faces = np.array(mesh.faces_buffer(), dtype="<u4")
    parts = [places.tobytes(), uv.tobytes(), faces.tobytes(), png]
    starts = np.cumsum([0] + [-(-len(p) // 4) * 4 for p in parts])
    body = b"".join(p.ljust(-(-len(p) // 4) * 4, b"\0") for p in parts)
    accessor = lambda view, kind, count, form, **more: {"bufferView": view, "componentType": kind, "count": count, "type": form} | more  # noqa: E731
    tree = {
        "asset": {"version": "2.0", "generator": f"acquire {__version__}"},
        "extensionsUsed": ["KHR_materials_emissive_strength"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [
            {
                "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1], "metallicFactor": 0, "roughnessFactor": 1},
                "emissiveTexture": {"index": 0},
                "emissiveFactor": [1, 1, 1],
                "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": strength}},
            }
        ],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "accessors": [
            accessor(0, 5126, len(places), "VEC3", min=places.min(0).tolist(), max=places.max(0).tolist()),
            accessor(1, 5126, len(uv), "VEC2"),
            accessor(2, 5125, len(faces), "SCALAR"),
        ],
        "bufferViews": [{"buffer": 0, "byteOffset": int(s), "byteLength": len(p)} for s, p in zip(starts, parts)],
        "buffers": [{"byteLength": len(body)}],
    }
    text = json.dumps(tree, separators=(",", ":")).encode()
    text = text.ljust(-(-len(text) // 4) * 4, b" ")
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(body), 0x004E4942) + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
