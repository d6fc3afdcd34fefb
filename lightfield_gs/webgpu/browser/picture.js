// The image of a frame on a canvas: bands of rows come one after the other, and the whole is shown at once.

import { TooLarge } from "./pipelines.js";

const SHADER = `
@group(0) @binding(0) var<storage, read> image: array<u32>;
@group(0) @binding(1) var<uniform> band: vec2u;  // first row, pixels of a row
@vertex fn corners(@builtin(vertex_index) i: u32) -> @builtin(position) vec4f {
  return vec4f(f32(i & 1u) * 4.0 - 1.0, f32(i >> 1u) * 4.0 - 1.0, 0.0, 1.0);
}
@fragment fn pixel(@builtin(position) at: vec4f) -> @location(0) vec4f {
  return vec4f(unpack4x8unorm(image[(u32(at.y) - band.x) * band.y + u32(at.x)]).rgb, 1.0);
}`;

export class Picture {
  constructor(device, canvas) {
    this.format = navigator.gpu.getPreferredCanvasFormat();
    Object.assign(this, { device, canvas, context: canvas.getContext("webgpu"), texture: null, bands: new Map() });
    const usage = GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.COPY_DST;
    this.context.configure({ device, format: this.format, alphaMode: "opaque", colorSpace: "srgb", usage });
    const module = device.createShaderModule({ code: SHADER }), fragment = { module, targets: [{ format: this.format }] };
    this.pipeline = device.createRenderPipeline({ layout: "auto", vertex: { module }, fragment });
  }

  /** Begins a picture of this size, in pixels. */
  begin(width, height) {
    if (Math.max(width, height) > this.device.limits.maxTextureDimension2D) throw new TooLarge(`${width} × ${height} pixels`);
    if (this.texture?.width === width && this.texture.height === height) return;
    this.texture?.destroy();
    const usage = GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.COPY_SRC;
    this.texture = this.device.createTexture({ size: [width, height], format: this.format, usage });
  }

  /** Takes rows of the picture from the beginning of a buffer of pixels. */
  take(first, rows, image) {
    const { device, texture } = this, encoder = device.createCommandEncoder();
    if (!this.bands.has(first))
      this.bands.set(first, device.createBuffer({ size: 8, usage: GPUBufferUsage.UNIFORM | GPUBufferUsage.COPY_DST }));
    device.queue.writeBuffer(this.bands.get(first), 0, new Uint32Array([first, texture.width]));
    const entries = [image, this.bands.get(first)].map((buffer, binding) => ({ binding, resource: { buffer } }));
    const pass = encoder.beginRenderPass({ colorAttachments: [{ view: texture.createView(), loadOp: "load", storeOp: "store" }] });
    pass.setPipeline(this.pipeline);
    pass.setBindGroup(0, device.createBindGroup({ layout: this.pipeline.getBindGroupLayout(0), entries }));
    pass.setScissorRect(0, first, texture.width, rows);
    pass.draw(3);
    pass.end();
    device.queue.submit([encoder.finish()]);
  }

  /** Shows the picture, pixel for pixel of the canvas. */
  end() {
    const { canvas, context, device, texture } = this, { width, height } = texture;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const encoder = device.createCommandEncoder();
    encoder.copyTextureToTexture({ texture }, { texture: context.getCurrentTexture() }, [width, height]);
    device.queue.submit([encoder.finish()]);
  }
}
