import pytest

from mjx_grasp.closing.config import (
    ActionConfig,
    CloserConfig,
    GripConfig,
    GuidanceConfig,
    LiftConfig,
    ObserverConfig,
    StageConfig,
)
from mjx_grasp.errors import InputError


def test_defaults_are_the_published_controller():
    c = CloserConfig()
    assert c.control_dt == 0.01
    assert (c.action.finger_rate, c.action.arm_rate) == (5.0, 0.15)
    assert (c.grip.force, c.grip.ramp_s, c.stages.acquisition_s) == (1.0, 0.5, 1.6)


@pytest.mark.wrong_types
@pytest.mark.parametrize(
    ("kind", "field", "value"),
    [
        (CloserConfig, "control_dt", 0.0),
        (CloserConfig, "control_dt", float("nan")),
        (GuidanceConfig, "speed", 0.0),
        (LiftConfig, "speed", 0.0),
        (LiftConfig, "height", 0.0),
        (LiftConfig, "ramp_s", 1.1),
        (GripConfig, "force", -0.1),
        (ActionConfig, "keep", 1.1),
        (ActionConfig, "residual", "drifting"),
        (StageConfig, "fingers", 0),
        (ObserverConfig, "contact_ticks", 0),
    ],
)
def test_impossible_controllers_are_refused_by_name(kind, field, value):
    with pytest.raises(InputError, match=rf"^{kind.__name__}\.{field}: "):
        kind(**{field: value})
