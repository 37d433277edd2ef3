#version 330
// Points of a face as its camera sees them.
in vec3 point, normal, ahead, behind;
in vec2 uv;
uniform mat3 axes;  // of the camera: right, up, backward
uniform vec3 eye;
uniform vec4 lens;  // focal length, principal point and side of the picture, pixels
uniform vec2 reach;  // of the depth
out vec3 place, turned, world, carried_ahead, carried_behind;
out vec2 at;

void main() {
    place = axes * (point - eye);
    turned = axes * normal;
    world = point;
    carried_ahead = ahead;
    carried_behind = behind;
    at = uv;
    float w = -place.z;
    vec2 pixel = vec2(lens.x * place.x, -lens.x * place.y) + lens.yz * w;
    vec2 screen = vec2(2.0 * pixel.x / lens.w - w, w - 2.0 * pixel.y / lens.w);
    float depth = (reach.y + reach.x) / (reach.y - reach.x) * w - 2.0 * reach.x * reach.y / (reach.y - reach.x);
    gl_Position = vec4(screen, depth, w);
}
