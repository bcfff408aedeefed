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
    """Rollouts, each followed by updates."""
    epochs: int = 5
    """Passes over each iteration's data."""
    minibatches: int = 4
    """Parts of each pass, by worlds; each gives one update."""
    discount: float = 0.99
    """γ per control step."""
    gae_lambda: float = 0.95
    """λ of the generalised advantage estimate."""
    clip: float = 0.2
    """How far the ratio of new to old action probability counts on either side of 1."""
    entropy: float = 0.0
    """Weight of the entropy bonus."""
    learning_rate: float = 1e-3
    """Adam's, at the beginning where it adapts to --ppo.desired-kl."""
    desired_kl: float | None = 0.01
    """Target of the adaptive learning rate; None keeps the rate fixed."""
    gradient_norm: float = 1.0
    """Longest gradient; longer ones are shortened to it."""
    reward_scale: float = 0.02
    """Factor on rewards, so that returns are of the size of 1."""
    value_weight: float = 0.5
    """Weight of the critic's loss."""
    hidden: tuple[int, ...] = (128, 128)
    """Layers of actor and critic, ELU."""
    action_std: float = 0.3
    """Initial standard deviation of the actions, which reach from −1 to 1."""
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
