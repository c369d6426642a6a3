"""SEVA (Stable Virtual Camera, Zhou et al. 2025) with weights that the user brings: an own network, reader and sampler.

Nothing of SEVA's code or weights is in here; its licence holds for the weights and for what is made with them
(`checkpoint.LICENCE`).
"""
