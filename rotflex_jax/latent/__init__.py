"""The torque that a model lacks, estimated over time from recordings, with its band."""

from rotflex_jax.latent.result import LatentTorque, TorqueCurve
from rotflex_jax.latent.torque import latent_torque

__all__ = ["LatentTorque", "TorqueCurve", "latent_torque"]
