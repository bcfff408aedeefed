"""Numbers of the PPO training (method §5, PPO) and its presets."""

from __future__ import annotations

from dataclasses import dataclass

from mjx_grasp.errors import InputError


@dataclass(frozen=True)
class PPOConfig:
    """PPO on Brax's parts, set to learn the closing task; the preset `paper` is as published."""

    worlds: int = 4096
    """Parallel environments."""
    unroll: int = 16
    """Control steps per environment and iteration."""
    iterations: int = 470
    epochs: int = 5
    """Passes over each iteration's data."""
    minibatches: int = 4
    discount: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy: float = 0.0
    learning_rate: float = 1e-3
    desired_kl: float | None = 0.01
    """Target of the adaptive learning rate; None keeps the rate fixed."""
    gradient_norm: float = 1.0
    reward_scale: float = 0.02
    value_weight: float = 0.5
    hidden: tuple[int, ...] = (128, 128)
    """Layers of actor and critic, ELU."""
    action_std: float = 0.3
    """Initial standard deviation of the actions [-]."""
    privileged_critic: bool = True
    """Whether the critic sees the simulator's state; the actor never does."""
    stagger: bool = True
    """Whether the first episodes end at random times, so that resets spread out."""

    def __post_init__(self):
        for name in ("worlds", "unroll", "iterations", "epochs", "minibatches"):
            if getattr(self, name) < 1:
                raise InputError(f"PPOConfig.{name}", getattr(self, name), "at least 1")
        if self.worlds % self.minibatches:
            raise InputError(
                "PPOConfig.worlds", self.worlds, f"a multiple of minibatches ({self.minibatches})"
            )
        if not 0 < self.discount <= 1:
            raise InputError("PPOConfig.discount", self.discount, "0 < γ <= 1")
        if self.action_std <= 0:
            raise InputError("PPOConfig.action_std", self.action_std, "a positive number")

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of one iteration."""
        return self.worlds * self.unroll
