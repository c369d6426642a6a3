"""The mathematics of cat3d: cameras, rays, trajectories, diffusion, fields, metrics. Tensors in, tensors out.

Needs only torch, numpy and safetensors, so that it runs on a bare GPU machine.
"""

__version__ = "0.1.0"
