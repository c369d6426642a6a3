"""The multi-view latent diffusion model and its sampler (paper, section 3.1 and appendix A)."""

from cat3d_core.diffusion.autoencoder import Autoencoder, autoencoder_loss
from cat3d_core.diffusion.bank import LatentBank
from cat3d_core.diffusion.checkpoint import describe, load_model, load_state, save_model, save_state, weights_hash
from cat3d_core.diffusion.config import SIZES, AutoencoderConfig, ModelConfig, ScheduleConfig, UNetConfig
from cat3d_core.diffusion.guidance import GuidanceConfig
from cat3d_core.diffusion.model import MultiViewModel
from cat3d_core.diffusion.sampler import SamplerConfig, sample
from cat3d_core.diffusion.schedule import Schedule
from cat3d_core.diffusion.training import TrainConfig, Trainer, diffusion_loss
from cat3d_core.diffusion.unet import MultiViewUNet, count_flops, count_parameters

__all__ = [
    "SIZES",
    "Autoencoder",
    "AutoencoderConfig",
    "GuidanceConfig",
    "LatentBank",
    "ModelConfig",
    "MultiViewModel",
    "MultiViewUNet",
    "SamplerConfig",
    "Schedule",
    "ScheduleConfig",
    "TrainConfig",
    "Trainer",
    "UNetConfig",
    "autoencoder_loss",
    "count_flops",
    "count_parameters",
    "describe",
    "diffusion_loss",
    "load_model",
    "load_state",
    "sample",
    "save_model",
    "save_state",
    "weights_hash",
]
