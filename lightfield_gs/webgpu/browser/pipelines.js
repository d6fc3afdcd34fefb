// Pipelines of the stages, compiled when first needed; the buffers of a frame by name; and a frame's work, submitted
// together. Twins of lightfield_gs/webgpu/pipelines.py and buffers.py.

import { source, variantOf } from "./shaders.js";

const LEAST_BYTES = 256, SLACK = 1.25; // a buffer is made larger than needed, so that it seldom has to grow

/** A scene or panel that this device cannot draw. */
export class TooLarge extends Error {}

export class Pipelines {
  constructor(device, shaders) {
    Object.assign(this, { device, shaders, made: new Map() });
  }

  /** The pipeline of a stage for a kind of frame, and the layout of its buffers: a promise. */
  stage(name, variant) {
    const own = variantOf(name, variant), key = `${name} ${JSON.stringify(own)}`;
    if (!this.made.has(key)) this.made.set(key, this.compiled(name, own));
    return this.made.get(key);
  }

  async compiled(name, variant) {
    const { device, shaders } = this;
    const entries = shaders.stages[name].bindings.map((binding) => {
      const [number, type] = shaders.bindings[binding];
      return { binding: number, visibility: GPUShaderStage.COMPUTE, buffer: { type } };
    });
    const layout = device.createBindGroupLayout({ entries });
    const pipeline = await device.createComputePipelineAsync({
      layout: device.createPipelineLayout({ bindGroupLayouts: [layout] }),
      compute: { module: device.createShaderModule({ code: source(shaders, name, variant) }), entryPoint: name },
    });
    return { pipeline, layout };
  }
}

export class Buffers {
  constructor(device) {
    const { maxStorageBufferBindingSize, maxBufferSize } = device.limits;
    Object.assign(this, { device, held: new Map(), staging: null });
    this.mostBytes = Math.floor(Math.min(maxStorageBufferBindingSize, maxBufferSize) / LEAST_BYTES) * LEAST_BYTES;
  }

  get(name) { return this.held.get(name); }

  /** Makes sure that a buffer has room, and returns its bytes. Its contents are lost where it grows. */
  storage(name, size) {
    const old = this.held.get(name);
    let needed = Math.max(size, LEAST_BYTES);
    if (needed > this.mostBytes) throw new TooLarge(`${name}: ${needed} bytes, of at most ${this.mostBytes}`);
    if (old && old.size >= needed) return old.size;
    if (old) needed = Math.min(needed * SLACK, this.mostBytes);
    return this.make(name, Math.ceil(needed / 4) * 4);
  }

  /** Makes sure that a buffer has just this many bytes, a multiple of 4. */
  exactly(name, size) {
    if (size > this.mostBytes) throw new TooLarge(`${name}: ${size} bytes, of at most ${this.mostBytes}`);
    if (this.held.get(name)?.size !== size) this.make(name, size);
  }

  make(name, size) {
    this.held.get(name)?.destroy();
    const usage = GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_SRC | GPUBufferUsage.COPY_DST;
    this.held.set(name, this.device.createBuffer({ size, usage }));
    return size;
  }

  /** Writes the beginning of a buffer, which must be large enough; one for parameters is made here. */
  write(name, data, uniform = false) {
    if (uniform && !this.held.has(name)) {
      const usage = GPUBufferUsage.UNIFORM | GPUBufferUsage.COPY_DST;
      this.held.set(name, this.device.createBuffer({ size: data.byteLength, usage }));
    }
    this.device.queue.writeBuffer(this.held.get(name), 0, data);
  }

  /** The first bytes of a buffer, once all work before has ended. */
  async read(name, size) {
    if (!this.staging || this.staging.size < size) {
      this.staging?.destroy();
      this.staging = this.device.createBuffer({ size, usage: GPUBufferUsage.MAP_READ | GPUBufferUsage.COPY_DST });
    }
    const encoder = this.device.createCommandEncoder();
    encoder.copyBufferToBuffer(this.held.get(name), 0, this.staging, 0, size);
    this.device.queue.submit([encoder.finish()]);
    await this.staging.mapAsync(GPUMapMode.READ, 0, size);
    const data = this.staging.getMappedRange(0, size).slice(0);
    this.staging.unmap();
    return data;
  }
}

export class Work {
  constructor(pipelines, buffers, variant) {
    Object.assign(this, { pipelines, buffers, variant, encoder: pipelines.device.createCommandEncoder() });
  }

  clear(...names) {
    for (const name of names) this.encoder.clearBuffer(this.buffers.get(name));
  }

  clearWords(name, first, count) { this.encoder.clearBuffer(this.buffers.get(name), 4 * first, 4 * count); }

  /** Adds a dispatch. names: buffers of bindings that are not named as their buffer. */
  async run(stage, groups, names = {}) {
    if (!groups.every(Boolean)) return;
    const { device, shaders } = this.pipelines, { pipeline, layout } = await this.pipelines.stage(stage, this.variant);
    const entries = shaders.stages[stage].bindings.map((binding) => ({
      binding: shaders.bindings[binding][0], resource: { buffer: this.buffers.get(names[binding] ?? binding) },
    }));
    const pass = this.encoder.beginComputePass();
    pass.setPipeline(pipeline);
    pass.setBindGroup(0, device.createBindGroup({ layout, entries }));
    pass.dispatchWorkgroups(...groups);
    pass.end();
  }

  submit() { this.pipelines.device.queue.submit([this.encoder.finish()]); }
}
