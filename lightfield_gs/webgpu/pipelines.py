"""The pipelines of the stages on a WebGPU device, compiled when first needed, and a frame's work as one submission."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from lightfield_gs.webgpu.buffers import Buffers
from lightfield_gs.webgpu.shaders import BINDINGS, STAGES, Variant, source

if TYPE_CHECKING:
    import wgpu

WORKGROUPS_ACROSS = 65535  # of a dispatch in one direction, at least


class Pipelines:
    """The pipelines of all kinds of frames that were drawn."""

    def __init__(self, device: wgpu.GPUDevice) -> None:
        self.device = device
        self._made: dict[tuple[str, Variant], tuple[wgpu.GPUComputePipeline, wgpu.GPUBindGroupLayout]] = {}
        self._groups: dict[tuple[wgpu.GPUBindGroupLayout, tuple[str, ...]], wgpu.GPUBindGroup] = {}
        self._version = 0  # of the buffers that are bound

    def stage(self, name: str, variant: Variant) -> tuple[wgpu.GPUComputePipeline, wgpu.GPUBindGroupLayout]:
        """Return the pipeline of a stage for a kind of frame, and the layout of its buffers."""
        import wgpu

        key = name, variant.of_stage(name)
        if key not in self._made:
            entries = [
                {"binding": number, "visibility": wgpu.ShaderStage.COMPUTE, "buffer": {"type": kind}}
                for number, kind in (BINDINGS[binding] for binding in STAGES[name].bindings)
            ]
            layout = self.device.create_bind_group_layout(entries=entries)
            module = self.device.create_shader_module(code=source(*key))
            pipeline = self.device.create_compute_pipeline(
                layout=self.device.create_pipeline_layout(bind_group_layouts=[layout]),
                compute={"module": module, "entry_point": name},
            )
            self._made[key] = pipeline, layout
        return self._made[key]

    def group(
        self, stage: str, layout: wgpu.GPUBindGroupLayout, buffers: Buffers, names: tuple[str, ...]
    ) -> wgpu.GPUBindGroup:
        """Return buffers bound to a stage; kept until a buffer is made."""
        if self._version != buffers.version:
            self._groups.clear()
            self._version = buffers.version
        key = layout, names
        if key not in self._groups:
            entries: list[Any] = []
            for binding, name in zip(STAGES[stage].bindings, names):
                resource = {"buffer": buffers[name], "offset": 0, "size": buffers[name].size}
                entries.append({"binding": BINDINGS[binding][0], "resource": resource})
            self._groups[key] = self.device.create_bind_group(layout=layout, entries=entries)
        return self._groups[key]


class Work:
    """Stages that are submitted together.

    Args:
        pipelines: Of the device.
        buffers: Of the frame.
        variant: The kind of frame.
        clock: Receives the name of each stage with the time of its begin and end, where the adapter has timestamps.
    """

    def __init__(self, pipelines: Pipelines, buffers: Buffers, variant: Variant, clock: Clock | None = None) -> None:
        self.pipelines, self.buffers, self.variant, self.clock = pipelines, buffers, variant, clock
        self.encoder = pipelines.device.create_command_encoder()

    def clear(self, *names: str) -> None:
        """Set buffers to zeros."""
        for name in names:
            self.encoder.clear_buffer(self.buffers[name])

    def clear_words(self, name: str, first: int, count: int) -> None:
        """Set numbers of a buffer to zero."""
        self.encoder.clear_buffer(self.buffers[name], 4 * first, 4 * count)

    def copy(self, source: str, source_at: int, target: str, target_at: int, size: int) -> None:
        """Copy bytes between buffers; places and size are multiples of 4."""
        self.encoder.copy_buffer_to_buffer(self.buffers[source], source_at, self.buffers[target], target_at, size)

    def run(self, stage: str, groups: tuple[int, ...], names: Mapping[str, str] | None = None) -> None:
        """Add a dispatch.

        Args:
            stage: Entry point.
            groups: Number of workgroups, in up to three directions.
            names: Buffers of bindings that are not named as their buffer.
        """
        if not all(groups):
            return
        pipeline, layout = self.pipelines.stage(stage, self.variant)
        bound = tuple((names or {}).get(binding, binding) for binding in STAGES[stage].bindings)
        group = self.pipelines.group(stage, layout, self.buffers, bound)
        timed = {} if self.clock is None else self.clock.writes(stage)
        timed_pass = self.encoder.begin_compute_pass(**timed)
        timed_pass.set_pipeline(pipeline)
        timed_pass.set_bind_group(0, group)
        timed_pass.dispatch_workgroups(*groups)
        timed_pass.end()

    def submit(self) -> None:
        """Hand the work to the device."""
        self.pipelines.device.queue.submit([self.encoder.finish()])


class Clock:
    """Timestamps of the stages of a frame, for measurements.

    Args:
        device: With the feature timestamp-query.
    """

    _MOST = 2048  # stamps of a frame

    def __init__(self, device: wgpu.GPUDevice) -> None:
        import wgpu

        self.device = device
        self._set = device.create_query_set(type="timestamp", count=self._MOST)
        usage = wgpu.BufferUsage.QUERY_RESOLVE | wgpu.BufferUsage.COPY_SRC
        self._resolved = device.create_buffer(size=8 * self._MOST, usage=usage)
        self._stages: list[str] = []

    def writes(self, stage: str) -> dict[str, Any]:
        """Return the arguments of a compute pass that is timed."""
        index = 2 * len(self._stages)
        self._stages.append(stage)
        stamps = {"query_set": self._set, "beginning_of_pass_write_index": index, "end_of_pass_write_index": index + 1}
        return {"timestamp_writes": stamps}

    def stages_ms(self) -> dict[str, float]:
        """Return the milliseconds of each stage since the last call, and from first to last as "frame"."""
        import numpy as np

        stages, self._stages = self._stages, []
        if not stages:
            return {}
        encoder = self.device.create_command_encoder()
        encoder.resolve_query_set(self._set, 0, 2 * len(stages), self._resolved, 0)
        self.device.queue.submit([encoder.finish()])
        data = self.device.queue.read_buffer(self._resolved, 0, 16 * len(stages))
        times = np.frombuffer(data, np.uint64).astype(np.float64).reshape(-1, 2) * 1e-6
        found = {"frame": float(times[-1, 1] - times[0, 0])}
        for stage, (begin, end) in zip(stages, times):
            found[stage] = found.get(stage, 0.0) + float(end - begin)
        return found
