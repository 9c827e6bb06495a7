// Deforms modal surfaces in the drawn vertex buffer: first the positions, then the normals from
// them.
//
// Both entry points run for all bodies of one dispatch at once: x counts vertices, y counts bodies.

struct Surface {
    // Number of vertices of the surface, and of the mesh that draws it (a sharp edge is drawn
    // twice).
    vertices: u32,
    drawn: u32,
    // Number of modes with which the basis was stored: the pitch of its blocks.
    modes: u32,
    // Offsets in `topology` of the list where each normal's corners begin, and of the corners.
    starts: u32,
    corners: u32,
    // Index of the first body of this dispatch in `jobs`.
    first: u32,
    // Offset in `topology` of the tangents, one per drawn vertex, or 0 where there are none.
    tangents: u32,
    pad: u32,
}

struct Job {
    // Offset of the body's modal coordinates in `coordinates`.
    q: u32,
    modes: u32,
    warped: u32,
    // Offset of the body's positions in `positions`.
    positions: u32,
    // Offset of the body's first vertex in `mesh`, size of a vertex, and offsets of position and
    // normal in a vertex, all in words.
    start: u32,
    stride: u32,
    position: u32,
    normal: u32,
    // Offset of the tangent in a vertex, in words, or NONE.
    tangent: u32,
    // Offset in `coordinates` of the displacements besides those of the coordinates, and their
    // number: four words each, of which the first is the vertex. The vertices ascend.
    moved: u32,
    moved_count: u32,
}

@group(0) @binding(0) var<uniform> surface: Surface;
// [vertex][axis], m.
@group(0) @binding(1) var<storage, read> rest: array<f32>;
// [block][mode][row][lane]: three rows of displacement and three of rotation, 16 vertices per
// block.
@group(0) @binding(2) var<storage, read> basis: array<f32>;
// For each drawn vertex its surface vertex and its normal, for each normal the start of its
// corners, then the corners with three vertices each, then for each drawn vertex the triangle of
// its tangent, the factors of that triangle's edges, and the sign of the bitangent.
@group(0) @binding(3) var<storage, read> topology: array<u32>;
@group(0) @binding(4) var<storage, read> jobs: array<Job>;
@group(0) @binding(5) var<storage, read> coordinates: array<f32>;
@group(0) @binding(6) var<storage, read_write> positions: array<f32>;
@group(0) @binding(7) var<storage, read_write> mesh: array<f32>;

const NONE: u32 = 0xffffffffu;
const BLOCK: u32 = 16u;
const ROWS: u32 = 6u;
const TAU: f32 = 6.283185307179586;
// Up to half a turn, |w|^2 <= pi^2, the series below are accurate to single precision.
const SERIES_LIMIT: f32 = 9.87;

// (1 - cos t) / t^2 and (t - sin t) / t^3 as series in s = t^2.
fn series(s: f32) -> vec2<f32> {
    var a = 1.5619206e-16;
    a = a * s - 4.7794773e-14;
    a = a * s + 1.1470746e-11;
    a = a * s - 2.0876756e-9;
    a = a * s + 2.755732e-7;
    a = a * s - 2.4801588e-5;
    a = a * s + 1.3888889e-3;
    a = a * s - 4.1666668e-2;
    a = a * s + 0.5;
    var b = 8.2206352e-18;
    b = b * s - 2.8114573e-15;
    b = b * s + 7.6471637e-13;
    b = b * s - 1.6059044e-10;
    b = b * s + 2.5052108e-8;
    b = b * s - 2.7557319e-6;
    b = b * s + 1.9841270e-4;
    b = b * s - 8.3333333e-3;
    b = b * s + 0.16666667;
    return vec2(a, b);
}

// Returns the two coefficients of modal warping for any rotation vector of squared length s. Sine
// and cosine come from the series too, because the built-in functions may be off by 5e-4.
fn coefficients(s: f32) -> vec2<f32> {
    if s <= SERIES_LIMIT {
        return series(s);
    }
    let t = sqrt(s);
    let r = t - TAU * round(t / TAU);
    let k = series(r * r);
    let versine = r * r * k.x;
    let sine = r - r * r * r * k.y;
    return vec2(versine / s, (t - sine) / (s * t));
}

// Returns the displacement of a vertex besides that of the coordinates, by bisection.
fn moved_by_hands(job: Job, vertex: f32) -> vec3<f32> {
    var low = 0u;
    var high = job.moved_count;
    while low < high {
        let middle = (low + high) / 2u;
        if coordinates[job.moved + 4u * middle] < vertex {
            low = middle + 1u;
        } else {
            high = middle;
        }
    }
    let at = job.moved + 4u * low;
    if low < job.moved_count && coordinates[at] == vertex {
        return vec3(coordinates[at + 1u], coordinates[at + 2u], coordinates[at + 3u]);
    }
    return vec3(0.0);
}

@compute @workgroup_size(64)
fn write_positions(@builtin(global_invocation_id) id: vec3<u32>) {
    let vertex = id.x;
    if vertex >= surface.vertices {
        return;
    }
    let job = jobs[surface.first + id.y];
    var at = (vertex / BLOCK) * surface.modes * ROWS * BLOCK + vertex % BLOCK;
    var d = vec3(0.0);
    var w = vec3(0.0);
    if job.warped != 0u {
        for (var k = 0u; k < job.modes; k++) {
            let q = coordinates[job.q + k];
            d += q * vec3(basis[at], basis[at + BLOCK], basis[at + 2u * BLOCK]);
            w += q * vec3(basis[at + 3u * BLOCK], basis[at + 4u * BLOCK], basis[at + 5u * BLOCK]);
            at += ROWS * BLOCK;
        }
        let c = coefficients(dot(w, w));
        let turned = cross(w, d);
        d += c.x * turned + c.y * cross(w, turned);
    } else {
        for (var k = 0u; k < job.modes; k++) {
            let q = coordinates[job.q + k];
            d += q * vec3(basis[at], basis[at + BLOCK], basis[at + 2u * BLOCK]);
            at += ROWS * BLOCK;
        }
    }
    d += moved_by_hands(job, f32(vertex));
    let to = job.positions + 3u * vertex;
    positions[to] = rest[3u * vertex] + d.x;
    positions[to + 1u] = rest[3u * vertex + 1u] + d.y;
    positions[to + 2u] = rest[3u * vertex + 2u] + d.z;
}

fn position_of(job: Job, vertex: u32) -> vec3<f32> {
    let at = job.positions + 3u * vertex;
    return vec3(positions[at], positions[at + 1u], positions[at + 2u]);
}

// Returns any unit vector across a unit vector (Duff et al. 2017).
fn across(normal: vec3<f32>) -> vec3<f32> {
    let side = select(-1.0, 1.0, normal.z >= 0.0);
    let a = -1.0 / (side + normal.z);
    let b = normal.x * normal.y * a;
    return vec3(b, side + normal.y * normal.y * a, -normal.y);
}

// Returns the tangent of a drawn vertex with this normal.
fn tangent_of(job: Job, drawn: u32, normal: vec3<f32>) -> vec4<f32> {
    let at = surface.tangents + 6u * drawn;
    let a = position_of(job, topology[at]);
    let b = position_of(job, topology[at + 1u]);
    let c = position_of(job, topology[at + 2u]);
    let along = bitcast<f32>(topology[at + 3u]) * (b - a) + bitcast<f32>(topology[at + 4u]) * (c - a);
    let flat_along = along - normal * dot(normal, along);
    let largest = max(max(abs(flat_along.x), abs(flat_along.y)), abs(flat_along.z));
    var unit = across(normal);
    if largest > 0.0 {
        unit = normalize(flat_along / largest);
    }
    return vec4(unit, bitcast<f32>(topology[at + 5u]));
}

@compute @workgroup_size(64)
fn write_mesh(@builtin(global_invocation_id) id: vec3<u32>) {
    let drawn = id.x;
    if drawn >= surface.drawn {
        return;
    }
    let job = jobs[surface.first + id.y];
    let group = topology[2u * drawn + 1u];
    // The cross product of two edges is the face normal times twice the area, so the sum weights
    // each normal by its area.
    var sum = vec3(0.0);
    let end = topology[surface.starts + group + 1u];
    for (var corner = topology[surface.starts + group]; corner < end; corner++) {
        let at = surface.corners + 3u * corner;
        let a = position_of(job, topology[at]);
        let b = position_of(job, topology[at + 1u]);
        let c = position_of(job, topology[at + 2u]);
        sum += cross(b - a, c - a);
    }
    // Division by the largest component comes first, because the square of a tiny triangle's area
    // would vanish in single precision.
    let largest = max(max(abs(sum.x), abs(sum.y)), abs(sum.z));
    var normal = vec3(0.0, 1.0, 0.0);
    if largest > 0.0 {
        normal = normalize(sum / largest);
    }
    let position = position_of(job, topology[2u * drawn]);
    let to = job.start + job.stride * drawn;
    mesh[to + job.position] = position.x;
    mesh[to + job.position + 1u] = position.y;
    mesh[to + job.position + 2u] = position.z;
    mesh[to + job.normal] = normal.x;
    mesh[to + job.normal + 1u] = normal.y;
    mesh[to + job.normal + 2u] = normal.z;
    if surface.tangents != 0u && job.tangent != NONE {
        let tangent = tangent_of(job, drawn, normal);
        mesh[to + job.tangent] = tangent.x;
        mesh[to + job.tangent + 1u] = tangent.y;
        mesh[to + job.tangent + 2u] = tangent.z;
        mesh[to + job.tangent + 3u] = tangent.w;
    }
}
