#version 330
// What a sample shows: facepipe.pictures.shade and facepipe.pictures.lighting, in float32.
in vec3 place, turned, world, carried_ahead, carried_behind;
in vec2 at;
uniform sampler2D diffuse_color_map, roughness_map, occlusion_map, opacity_map, normal_map, key_map;
uniform vec3 diffuse_color_scale, normal_scale, roughness, occlusion, opacity;  // of numbers: scale, bias, channel
uniform float threshold, mirror, exposure;
uniform int kind, double_sided, bumpy, loose, box_count, plain;
uniform mat3 axes;
uniform mat4 to_map;
uniform vec3 up, sky, ground;
uniform mat3 box_axes[3];  // columns: across, up, towards
uniform vec3 box_color[3];
uniform vec4 box_shape[3];  // tangents of half the width and height, of the disc of that area, glare
out vec4 color;

const vec3 BOUNCED = vec3(0.45, 0.32, 0.27);
const float GOLDEN = 2.39996323;

float number(sampler2D map, vec3 how) {
    return clamp(texture(map, at)[int(how.z)] * how.x + how.y, 0.0, 1.0);
}

float grain() {
    return fract(52.9829189 * fract(dot(gl_FragCoord.xy, vec2(0.06711056, 0.00583715))));
}

vec3 bent(vec3 normal) {
    vec3 p1 = dFdx(place), p2 = dFdy(place);
    vec2 t1 = dFdx(at), t2 = dFdy(at);
    float area = t1.x * t2.y - t1.y * t2.x;
    if (bumpy == 0 || abs(area) < 1e-14) return normal;
    vec3 along = normalize((p1 * t2.y - p2 * t1.y) * sign(area));
    vec3 across = normalize((p2 * t1.x - p1 * t2.x) * sign(area));
    vec3 texel = texture(normal_map, at).xyz * normal_scale - (normal_scale - 1.0);
    vec3 flat_part = along * texel.x + across * texel.y;
    return normalize(flat_part + normal * (max(texel.z, 0.05) - dot(flat_part, normal)));
}

// Percentage-closer soft shadows (Fernando 2005).
float key_light(vec3 outward) {
    vec3 towards = box_axes[0] * vec3(0.0, 0.0, 1.0);
    float facing = dot(outward, towards);
    if (facing < -0.35) return 1.0;
    mat3 scaled = transpose(mat3(to_map));
    float side = float(textureSize(key_map, 0).x), pixel = 2.0 / side / length(scaled[0]);
    float lift = 1.5 * sqrt(max(1.0 - facing * facing, 0.0)) + 0.5;
    vec3 spot = (to_map * vec4(world + lift * pixel * (outward * axes), 1.0)).xyz * 0.5 + 0.5;
    float deep = side * length(scaled[0]) / length(scaled[2]);  // map pixels of the whole depth
    float turn = 6.2831853 * grain(), gap = 0.0, blockers = 0.0;
    for (int i = 0; i < 12; i++) {
        float angle = turn + GOLDEN * float(i), radius = sqrt((float(i) + 0.5) / 12.0) * 24.0;
        float above = (spot.z - texture(key_map, spot.xy + radius * vec2(cos(angle), sin(angle)) / side).x) * deep;
        if (above > 0.5) { gap += above; blockers += 1.0; }
    }
    if (blockers == 0.0) return 1.0;
    float tangent = box_shape[0].z, width = clamp(gap / blockers * tangent, 1.0, 40.0), lit = 0.0;
    for (int i = 0; i < 12; i++) {
        float angle = turn + GOLDEN * float(i), radius = sqrt((float(i) + 0.5) / 12.0) * width;
        float above = (spot.z - texture(key_map, spot.xy + radius * vec2(cos(angle), sin(angle)) / side).x) * deep;
        lit += above <= 0.5 + 0.5 * radius ? 1.0 : 0.0;
    }
    return lit / 12.0;
}

float sheen_scale(float rough, float facing, out float offset) {
    float r0 = 1.0 - rough, r1 = 0.0425 - 0.0275 * rough, r2 = 1.04 - 0.572 * rough, r3 = 0.022 * rough - 0.04;
    float bend = min(r0 * r0, exp2(-9.28 * facing)) * r0 + r1;
    offset = max(r3 + 1.04 * bend, 0.0);
    return r2 - 1.04 * bend;
}

float reflected(int box, vec3 normal, vec3 towards_eye, vec3 mirrored, float facing, float rough, float shine) {
    vec4 shape = box_shape[box];
    if (dot(normal, box_axes[box][2]) <= -shape.z) return 0.0;
    float alpha = max(rough * rough, 0.003);
    vec3 seen = mirrored * box_axes[box];
    vec2 spot = clamp(seen.xy / max(seen.z, 0.02), -shape.xy, shape.xy);
    vec3 light = normalize(box_axes[box] * vec3(spot, 1.0)), half_way = normalize(light + towards_eye);
    float cosine = max(dot(normal, light), 0.0), near = dot(normal, half_way);
    float lobe = alpha / (near * near * (alpha * alpha - 1.0) + 1.0);
    float widened = min(alpha + 0.35 * shape.z, 1.0), masking = alpha / 2.0;
    float unmasked = (cosine * (1.0 - masking) + masking) * (facing * (1.0 - masking) + masking);
    float strength = shape.w * cosine * pow(lobe * alpha / widened, 2.0) / (4.0 * unmasked);
    return (shine + (1.0 - shine) * pow(1.0 - dot(light, half_way), 5.0)) * strength;
}

vec3 toned(vec3 light) {
    vec3 c = light * exposure;
    return clamp(c * (2.51 * c + 0.03) / (c * (2.43 * c + 0.59) + 0.14), 0.0, 1.0);
}

vec3 dome(float height) {
    return mix(ground, sky, 0.5 + 0.5 * height);
}

void main() {
    vec3 base = clamp(texture(diffuse_color_map, at).rgb * diffuse_color_scale, 0.0, 1.0);
    float rough = number(roughness_map, roughness), open = number(opacity_map, opacity);
    float matt = loose == 1 ? min(rough / 0.4, 1.0) : 0.0, presence = open;
    if (threshold > 0.0) {
        if (clamp((open - threshold) / 0.5 + 0.5, 0.0, 1.0) < grain() * 0.98 + 0.01) discard;
        open = presence = 1.0;
    } else if (loose == 1) {
        presence = max(open, (1.0 - matt) * min(open / 0.02, 1.0));
        if (presence < 0.002) discard;
    }
    if (plain == 1) {
        color = vec4(carried_ahead * open, open);
        return;
    }
    bool front = gl_FrontFacing;
    vec3 towards_eye = normalize(-place);
    vec3 normal = bent(normalize(turned)) * (front ? 1.0 : -1.0);
    float inside = front || double_sided == 1 ? 1.0 : 0.28;
    float gloss = 1.0 - (loose == 1 ? 0.75 * matt : 0.0), through = loose == 1 ? 0.35 * matt : 0.0;
    vec3 carried = front ? carried_ahead : (double_sided == 1 ? carried_behind : vec3(1.0));
    carried = (carried + through * (1.0 - carried)) * number(occlusion_map, occlusion) * inside;
    float hidden = 1.0 - carried.x;
    vec3 open_sky = carried.x + BOUNCED * inside * hidden * hidden;
    vec3 seen = normalize(normal + max(0.05 - dot(normal, towards_eye), 0.0) * towards_eye);
    float facing = max(dot(seen, towards_eye), 0.05), offset, scale = sheen_scale(rough, facing, offset);
    vec3 mirrored = 2.0 * facing * seen - towards_eye;
    float sheen = mirror * scale + offset;
    vec3 diffuse = open_sky / (1.0 - base * (1.0 - open_sky) * 0.9) * dome(dot(normal, up) * 2.0 / 3.0);
    vec3 highlights = open_sky * dome(dot(mirrored, up)) * sheen;
    vec3 creep = 0.30 * pow(base / max(max(base.r, max(base.g, base.b)), 1e-4), vec3(1.25));
    float arriving = key_light(normal);
    arriving += through * (1.0 - arriving);
    for (int box = 0; box < box_count; box++) {
        vec3 light = box_color[box] * (box == 0 ? inside * arriving : (box == 1 ? carried.y : carried.z));
        vec3 wrap = creep + 0.4 * box_shape[box].z;
        diffuse += light * max(dot(normal, box_axes[box][2]) + wrap, 0.0) / ((1.0 + wrap) * (1.0 + wrap));
        highlights += light * reflected(box, seen, towards_eye, mirrored, facing, rough, mirror);
    }
    highlights *= gloss;
    vec3 whole = toned(base * diffuse * (1.0 - sheen) + highlights);
    color = vec4(whole * open + toned(highlights) * max(presence - open, 0.0), open);
}
