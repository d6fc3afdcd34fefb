// The browser's GPU.

/** Opens the device: {device}, or {lacks} where there is none: "webgpu", "adapter", or "hardware", where only a program
 *  of the CPU would draw, many times as slowly. */
export async function openDevice(allowSoftware) {
  const gpu = navigator.gpu;
  if (!gpu) return { lacks: "webgpu" };
  const adapter = await gpu.requestAdapter({ powerPreference: "high-performance" });
  if (!adapter) return { lacks: "adapter" };
  if ((adapter.info?.isFallbackAdapter ?? adapter.isFallbackAdapter) && !allowSoftware) return { lacks: "hardware" };
  const names = ["maxBufferSize", "maxStorageBufferBindingSize", "maxTextureDimension2D"];
  const requiredLimits = Object.fromEntries(names.map((name) => [name, adapter.limits[name]]));
  return { device: await adapter.requestDevice({ requiredLimits }) };
}
