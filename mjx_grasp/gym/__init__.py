"""Tasks as Gymnasium environments, for other libraries to train on; needs the extra `gym`.

Importing this registers the closing task, for `gymnasium.make_vec("mjx_grasp/Closing-v0", 64)`.
"""

try:
    import gymnasium
except ImportError as error:
    raise ImportError("mjx_grasp.gym needs Gymnasium: pip install 'mjx_grasp[gym]'") from error

from mjx_grasp.gym.closing import closing_env as closing_env
from mjx_grasp.gym.closing import closing_vector_env as closing_vector_env
from mjx_grasp.gym.envs import TaskEnv as TaskEnv
from mjx_grasp.gym.envs import TaskVectorEnv as TaskVectorEnv

gymnasium.register(
    "mjx_grasp/Closing-v0",
    entry_point="mjx_grasp.gym.closing:closing_env",
    vector_entry_point="mjx_grasp.gym.closing:closing_vector_env",
)
