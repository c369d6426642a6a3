"""How to sample: as the paper does, with the least work for the same error, and as suits briefly trained models."""

from __future__ import annotations

from cat3d_core.diffusion.guidance import GuidanceConfig
from cat3d_core.diffusion.sampler import SamplerConfig

#: The paper's (appendix A): DDIM, 50 steps, guidance 3.
PAPER = SamplerConfig("ddim", "trailing", 50, GuidanceConfig(3.0))
#: On the front of `cat3d bench sampler`: the fewest steps whose error, on problems with a known answer, is within that
#: of the paper's sampler. Guidance above a log-SNR of 2 changed nothing there.
MEASURED = SamplerConfig("unipc", "log_snr", 10, GuidanceConfig(3.0, high_log_snr=2.0))
#: A briefly trained model predicts well what its views have in common and badly the rest: it is best after few steps
#: without guidance, and what it does in many shows how it develops.
FEW_STEPS = SamplerConfig("ddim", "trailing", 4, GuidanceConfig(1.0))
MANY_STEPS = SamplerConfig("unipc", "log_snr", 20, GuidanceConfig(1.0))
