"""Training the multi-view model: scenes, autoencoder, bank of latents, the loop, sample sheets.

Everything here but `sheets` and `loop` needs torch, safetensors and the core alone, for GPU machines with no more.
"""
