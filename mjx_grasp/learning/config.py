"""Numbers of the PPO training (method §5, PPO) and its presets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from mjx_grasp.errors import InputError
from mjx_grasp.records.settings import (
    Count,
    NonNegative,
    Positive,
    Range,
    Settings,
    Several,
    Share,
    WholeNumber,
)


@dataclass(frozen=True)
class PPOConfig(Settings):
    """PPO on Brax's parts, set to learn the closing task; the preset `paper` is as published."""

    worlds: Count = 4096
    """parallel environments [-]"""
    unroll: Count = 16
    """control steps per environment and iteration [-]"""
    iterations: Count = 470
    """rollouts, each followed by updates [-]"""
    epochs: Count = 5
    """passes over each iteration's data [-]"""
    minibatches: Count = 4
    """parts of each pass, by worlds; each gives one update [-]"""
    discount: Annotated[float, Range(0, 1, above=True)] = 0.99
    """γ per control step [-]"""
    gae_lambda: Share = 0.95
    """λ of the generalised advantage estimate [-]"""
    clip: Positive = 0.2
    """how far the ratio of new to old action probability counts on either side of 1 [-]"""
    entropy: NonNegative = 0.0
    """weight of the entropy bonus [-]"""
    learning_rate: Positive = 1e-3
    """Adam's, at the beginning where it adapts to --ppo.desired-kl [-]"""
    critic_rate: Positive | None = None
    """Adam's for the critic, which need not wait for the actor's; None: the same [-]"""
    desired_kl: Positive | None = 0.01
    """target of the adaptive learning rate; None keeps the rate fixed [nat]"""
    tuning: WholeNumber = 0
    """of these iterations the last ones, at the fixed rate of --ppo.learning-rate [-]"""
    critic_first: Share = 0.0
    """share of the iterations, the first ones, in which the critic alone learns [-]"""
    averaged: Share = 0.0
    """share of the iterations, the last ones, the mean of whose weights is the policy; 0 for the
    weights that the last one ended with [-]"""
    gradient_norm: Positive = 1.0
    """longest gradient; longer ones are shortened to it [-]"""
    reward_scale: Positive = 0.02
    """factor on rewards, so that returns are of the size of 1 [-]"""
    value_weight: NonNegative = 0.5
    """weight of the critic's loss [-]"""
    hidden: Annotated[tuple[Count, ...], Several()] = (128, 128)
    """units of each hidden layer of actor and critic, ELU [-]"""
    action_std: Positive = 0.3
    """initial standard deviation of the actions, which reach from −1 to 1 [-]"""
    value_clip: Positive | None = None
    """how far an iteration may move the critic's values, in scaled rewards: its targets are made of
    its own values, which may run away together; None for no bound [-]"""
    privileged_critic: bool = True
    """whether the critic sees the simulator's state; the actor never does"""
    stagger: bool = True
    """whether the first episodes end at random times, so that resets spread out"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.tuning > self.iterations:
            raise InputError(self.name_of("tuning"), self.tuning, f"at most {self.iterations}")
        if self.worlds % self.minibatches:
            multiple = f"a multiple of minibatches ({self.minibatches})"
            raise InputError(self.name_of("worlds"), self.worlds, multiple)

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of one iteration."""
        return self.worlds * self.unroll
