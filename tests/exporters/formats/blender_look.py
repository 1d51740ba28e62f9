"""Bounds, colours and a picture of files as Blender imports them. Run inside Blender, not by pytest:

blender --background --factory-startup --python blender_look.py -- JOBS.json

JOBS is a list of {"file", "camera": {"c2w", "width", "height", "fx", "fy", "cx", "cy"}, "picture", "arrays"}.
The pictures are PNG with alpha, rendered with the view transform Standard; `arrays` is the path of an NPZ of
what was imported. A GLB keeps the material that Blender's importer makes, so its picture shows what a user
sees first. Other files get the material that docs/export.md describes: an emission of the colour attribute,
and for a volume an absorption too.
"""

import json
import sys
from pathlib import Path

import bpy  # pyright: ignore[reportMissingImports]
import numpy as np

if not hasattr(np, "bool"):
    # Debian 12 ships Blender 3.4 with a numpy that no longer has `bool`, which the glTF importer uses.
    np.bool = bool


def main() -> None:
    for job in json.loads(Path(sys.argv[sys.argv.index("--") + 1]).read_text()):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        load(job["file"])
        thing = next(o for o in bpy.context.scene.objects if o.type in ("MESH", "VOLUME"))
        bpy.context.view_layer.update()
        arrays = look_at_volume(thing) if thing.type == "VOLUME" else look_at_mesh(thing)
        np.savez(job["arrays"], **arrays)
        if not job["file"].endswith(".glb"):
            thing.data.materials.clear()
            thing.data.materials.append(shown(thing, arrays))
        render(job["camera"], job["picture"])


def load(file: str) -> None:
    importers = {
        ".glb": lambda: bpy.ops.import_scene.gltf,
        ".obj": lambda: bpy.ops.wm.obj_import,
        ".ply": lambda: bpy.ops.import_mesh.ply if bpy.app.version < (4, 0) else bpy.ops.wm.ply_import,
        ".vdb": lambda: bpy.ops.object.volume_import,
        ".usdc": lambda: bpy.ops.wm.usd_import,
    }
    importers[Path(file).suffix]()(filepath=file)


def look_at_mesh(thing) -> dict:
    mesh = thing.data
    places = np.array([thing.matrix_world @ vertex.co for vertex in mesh.vertices])
    attribute = mesh.color_attributes[0]
    raw = np.empty(4 * len(attribute.data), np.float32)
    attribute.data.foreach_get("color", raw)  # linear values, however the attribute is stored
    corners = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("vertex_index", corners)
    colours = np.zeros((len(places), 4), np.float32)
    colours[corners if attribute.domain == "CORNER" else slice(None)] = raw.reshape(-1, 4)
    normals = np.array([thing.matrix_world.to_3x3() @ vertex.normal for vertex in mesh.vertices])
    return {
        "places": places,
        "colours": colours,
        "normals": normals,
        "n_faces": len(mesh.polygons),
        "name": attribute.name,
    }


def look_at_volume(thing) -> dict:
    from mathutils import Vector  # pyright: ignore[reportMissingImports]

    grids = thing.data.grids
    grids.load()
    corners = np.array([thing.matrix_world @ Vector(c) for c in thing.bound_box])
    return {
        "places": corners,
        "names": [grid.name for grid in grids],
        "matrix": np.array(thing.matrix_world @ grids["density"].matrix_object),
        "channels": [grid.channels for grid in grids],
    }


def shown(thing, arrays: dict):
    material = bpy.data.materials.new("shown")
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    output, emission = tree.nodes.new("ShaderNodeOutputMaterial"), tree.nodes.new("ShaderNodeEmission")
    colour = tree.nodes.new("ShaderNodeAttribute")
    tree.links.new(colour.outputs["Color"], emission.inputs["Color"])
    if thing.type == "MESH":
        colour.attribute_name = str(arrays["name"])
        tree.links.new(emission.outputs[0], output.inputs["Surface"])
        return material
    colour.attribute_name = "color"
    density, absorption = tree.nodes.new("ShaderNodeAttribute"), tree.nodes.new("ShaderNodeVolumeAbsorption")
    density.attribute_name = "density"
    absorption.inputs["Color"].default_value = 0, 0, 0, 1
    both = tree.nodes.new("ShaderNodeAddShader")
    tree.links.new(density.outputs["Fac"], absorption.inputs["Density"])
    tree.links.new(density.outputs["Fac"], emission.inputs["Strength"])
    tree.links.new(emission.outputs[0], both.inputs[0])
    tree.links.new(absorption.outputs[0], both.inputs[1])
    tree.links.new(both.outputs[0], output.inputs["Volume"])
    return material


def render(camera: dict, picture: str) -> None:
    from mathutils import Matrix  # pyright: ignore[reportMissingImports]

    scene = bpy.context.scene
    data = bpy.data.cameras.new("camera")
    width, height = camera["width"], camera["height"]
    data.sensor_fit, data.sensor_width = "HORIZONTAL", 36
    data.lens = camera["fx"] * 36 / width
    data.shift_x, data.shift_y = (width / 2 - camera["cx"]) / width, (camera["cy"] - height / 2) / width
    data.clip_start, data.clip_end = 0.01, 1000
    scene.camera = bpy.data.objects.new("camera", data)
    scene.camera.matrix_world = Matrix(camera["c2w"])
    scene.collection.objects.link(scene.camera)
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples = "CPU", 16
    scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
    scene.cycles.pixel_filter_type = "BOX"
    scene.cycles.volume_step_rate = 0.5
    scene.render.threads_mode, scene.render.threads = "FIXED", 2
    scene.render.resolution_x, scene.render.resolution_y = width, height
    scene.render.resolution_percentage = 100
    scene.render.film_transparent = True
    scene.view_settings.view_transform = "Standard"
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGBA"
    scene.render.filepath = picture
    bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main()
