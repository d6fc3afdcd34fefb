"""Method "direct" by WebGPU: the picture of a panel on GPUs of any maker, by the stages of csrc/webgpu."""
