"""A trial of a whole grasp, for tests of what is made of many."""

from mjx_grasp.evaluation.grasps.results import GraspRow


def row(outcome="success", name="box"):
    """One that ended in some way."""
    held = outcome == "success"
    return GraspRow(
        object=name, outcome=outcome, failure="none", handoff_s=2.0, lift_s=3.0,
        lifted_s=4.0 if held else None, up_at_9s=held, tip_error_mm=(1.0, 2.0, 3.0),
        midpoint_mm=1.0, force_mean_n=2.5 if held else None, force_peak_n=5.0, peak_rise_m=0.1,
        returns=0, replans=0, broken=False, overflow_ticks=0,
    )  # fmt: skip
