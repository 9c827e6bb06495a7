#!/usr/bin/env python3
"""Makes bird.glb in Blender, by the steps of docs/blender.md, and a picture of what is painted.

    blender --background --python tests/blender/bird.py -- OUT.glb [PICTURE.png]
    python tests/blender/bird.py OUT.glb [PICTURE.png]    # with Blender as a module: pip install bpy

A small bird of one closed mesh, 0.3 m tall: a body, a head and a beak, with two materials. The beak
is painted fifty times as stiff, the crown as half as dense, and the feet are fixed. The picture has
the model, and then where it is fixed, stiff and dense.
"""

import math
import pathlib
import sys

import bpy

arguments = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
out = pathlib.Path(arguments[0]).resolve()
picture = pathlib.Path(arguments[1]).resolve() if len(arguments) > 1 else None


def clear():
    bpy.ops.wm.read_factory_settings(use_empty=True)


def part(make, scale, turn=(0.0, 0.0, 0.0)):
    make()
    bpy.context.object.scale = scale
    bpy.context.object.rotation_euler = turn
    return bpy.context.object


def model():
    """One closed mesh of a body, a head, a beak and a foot, in meters; Blender's z is up."""
    ball = bpy.ops.mesh.primitive_uv_sphere_add
    parts = [
        part(lambda: ball(radius=1, location=(0, 0, 0.11)), (0.075, 0.085, 0.095)),
        part(lambda: ball(radius=1, location=(0, -0.02, 0.225)), (0.055, 0.055, 0.055)),
        part(
            lambda: bpy.ops.mesh.primitive_cone_add(radius1=0.022, radius2=0.004, depth=0.09,
                                                    location=(0, -0.095, 0.222)),
            (1, 1, 1), (math.radians(90), 0, 0),
        ),
        part(lambda: bpy.ops.mesh.primitive_cylinder_add(radius=0.06, depth=0.04, location=(0, 0, 0.02)),
             (1, 1, 1)),
    ]
    for one in parts:
        one.select_set(True)
    bpy.context.view_layer.objects.active = parts[0]
    bpy.ops.object.join()
    bird = bpy.context.object
    bird.name = bird.data.name = "bird"
    # Object, Apply, Scale: the mesh is taken in its own space.
    bpy.ops.object.transform_apply(location=True, rotation=True, scale=True)
    # Parts that cross each other become one surface.
    remesh = bird.modifiers.new("remesh", "REMESH")
    remesh.mode, remesh.voxel_size, remesh.use_smooth_shade = "VOXEL", 0.008, True
    bpy.ops.object.modifier_apply(modifier="remesh")
    smooth = bird.modifiers.new("smooth", "SMOOTH")
    smooth.iterations = 4
    bpy.ops.object.modifier_apply(modifier="smooth")
    return bird


def material(name, color):
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    shader = made.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (*color, 1.0)
    shader.inputs["Roughness"].default_value = 0.5
    return made


def is_beak(at):
    return at.y < -0.072 and at.z > 0.19


def color(bird):
    """Two material slots, of which glTF makes a primitive each."""
    bird.data.materials.append(material("feathers", (0.28, 0.55, 0.47)))
    bird.data.materials.append(material("horn", (0.95, 0.55, 0.12)))
    for face in bird.data.polygons:
        face.material_index = int(is_beak(face.center))


def set_attribute(bird, name, value, chosen):
    """Edit Mode: select vertices, and Mesh, Set Attribute."""
    bird.data.attributes.active = bird.data.attributes[name]
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_mode(type="VERT")
    bpy.ops.mesh.select_all(action="DESELECT")
    bpy.ops.object.mode_set(mode="OBJECT")
    for vertex in bird.data.vertices:
        vertex.select = chosen(vertex.co)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.attribute_set(value_float=value)
    bpy.ops.object.mode_set(mode="OBJECT")


def paint(bird):
    """Object Data Properties, Attributes, plus: domain Vertex, data type Float."""
    for name in ("_ANCHOR", "_STIFFNESS", "_DENSITY"):
        bpy.ops.geometry.attribute_add(name=name, domain="POINT", data_type="FLOAT")
    set_attribute(bird, "_STIFFNESS", 1.0, lambda at: True)
    set_attribute(bird, "_DENSITY", 1.0, lambda at: True)
    set_attribute(bird, "_ANCHOR", 1.0, lambda at: at.z < 0.012)
    set_attribute(bird, "_STIFFNESS", 50.0, is_beak)
    set_attribute(bird, "_DENSITY", 0.5, lambda at: at.z > 0.25)


def describe(bird):
    """Object Properties, Custom Properties, New."""
    bird["stiffness"] = 3.0e4
    bird["density"] = 1000.0


def export(bird):
    bpy.ops.object.select_all(action="DESELECT")
    bird.select_set(True)
    bpy.ops.export_scene.gltf(
        filepath=str(out),
        export_format="GLB",
        export_yup=True,
        export_extras=True,
        export_attributes=True,
        export_texcoords=True,
        export_normals=True,
    )


def shown(attribute, largest):
    """A material that shows an attribute, from blue at 0 to red at its largest value."""
    made = bpy.data.materials.new(attribute)
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    value = nodes.new("ShaderNodeAttribute")
    value.attribute_name = attribute
    share = nodes.new("ShaderNodeMath")
    share.operation, share.inputs[1].default_value = "DIVIDE", largest
    ramp = nodes.new("ShaderNodeValToRGB")
    ramp.color_ramp.elements[0].color = (0.05, 0.07, 0.35, 1)
    ramp.color_ramp.elements[1].color = (0.95, 0.25, 0.05, 1)
    links.new(value.outputs["Fac"], share.inputs[0])
    links.new(share.outputs[0], ramp.inputs[0])
    links.new(ramp.outputs[0], nodes["Principled BSDF"].inputs["Base Color"])
    return made


def render(bird):
    """The model and each of its attributes, side by side."""
    angle = math.radians(50)
    for place, (attribute, largest) in enumerate([("_ANCHOR", 1.0), ("_STIFFNESS", 50.0), ("_DENSITY", 1.0)], 1):
        other = bird.copy()
        other.data = bird.data.copy()
        other.location = (0.26 * place * math.cos(angle), 0.26 * place * math.sin(angle), 0.0)
        other.data.materials.clear()
        other.data.materials.append(shown(attribute, largest))
        bpy.context.collection.objects.link(other)
    scene = bpy.context.scene
    bpy.ops.object.light_add(type="SUN", rotation=(0.7, 0.3, 0.4))
    bpy.context.object.data.energy = 3.0
    middle = (0.39 * math.cos(angle), 0.39 * math.sin(angle), 0.145)
    back = (math.sin(angle), -math.cos(angle))
    bpy.ops.object.camera_add(
        location=(middle[0] + 2 * back[0], middle[1] + 2 * back[1], middle[2] + 0.4),
        rotation=(math.radians(78.7), 0, angle),
    )
    scene.camera = bpy.context.object
    scene.camera.data.type, scene.camera.data.ortho_scale = "ORTHO", 1.06
    world = bpy.data.worlds.new("world")
    scene.world, world.use_nodes = world, True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.85, 0.86, 0.88, 1)
    world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.5
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 32, False
    scene.render.resolution_x, scene.render.resolution_y = 1120, 360
    scene.view_settings.view_transform = "Standard"
    scene.render.filepath = str(picture)
    bpy.ops.render.render(write_still=True)


clear()
bird = model()
color(bird)
paint(bird)
describe(bird)
export(bird)
print(f"{out.name}: {len(bird.data.vertices)} vertices, {out.stat().st_size} bytes")
if picture:
    render(bird)
