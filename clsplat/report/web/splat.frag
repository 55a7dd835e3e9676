#version 300 es
// Alpha of a splat at a pixel, as cl/include/footprint.h; blended from back to front.
precision highp float;

in vec2 across;
flat in vec4 colour;
out vec4 fragment;

void main() {
    float alpha = min(0.99, colour.a * exp(-0.5 * dot(across, across)));
    if (alpha < 1.0 / 255.0)
        discard;
    fragment = vec4(colour.rgb * alpha, alpha);
}
