"""The torque that a model does not know of: a photograph of the missing force, with its band."""

from rotflex_jax.latent.curve import Curve
from rotflex_jax.latent.result import LatentTorque
from rotflex_jax.latent.torque import latent_torque

__all__ = ["Curve", "LatentTorque", "latent_torque"]
