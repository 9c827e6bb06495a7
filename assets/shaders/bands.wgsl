// The body's own light, in bands along its texture coordinates, over Bevy's standard lighting. It
// runs in the fragment stage only: the surface has been bent before.
#import bevy_pbr::{
    forward_io::{FragmentOutput, VertexOutput},
    mesh_view_bindings::{globals, view},
    pbr_fragment::pbr_input_from_standard_material,
    pbr_functions::{apply_pbr_lighting, main_pass_post_lighting_processing},
}

struct Bands {
    glow: vec4<f32>,
    count: f32,
    speed: f32,
}

@group(#{MATERIAL_BIND_GROUP}) @binding(100) var<uniform> bands: Bands;

@fragment
fn fragment(in: VertexOutput, @builtin(front_facing) front: bool) -> FragmentOutput {
    var pbr = pbr_input_from_standard_material(in, front);
    var out: FragmentOutput;
    out.color = apply_pbr_lighting(pbr);

    let along = bands.count * in.uv.y - bands.speed * globals.time;
    let band = smoothstep(0.55, 0.95, 0.5 + 0.5 * sin(6.2831853 * along));
    // Brighter at the rim, where one looks along the surface.
    let toward = normalize(view.world_position - in.world_position.xyz);
    let rim = pow(1.0 - saturate(dot(normalize(in.world_normal), toward)), 3.0);
    out.color = vec4(out.color.rgb + bands.glow.rgb * (0.55 * band + 0.8 * rim), out.color.a);

    out.color = main_pass_post_lighting_processing(pbr, out.color);
    return out;
}
