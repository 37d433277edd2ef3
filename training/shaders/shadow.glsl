#version 330
// Points as the key light sees them.
in vec3 point;
uniform mat4 to_map;

void main() {
    gl_Position = to_map * vec4(point, 1.0);
}
