"""`python -m mjx_grasp.export`: a policy as ONNX, to run where there is no JAX.

Needs the extra `export` (jax2onnx, onnxruntime).
"""

from mjx_grasp.cli import run_command, starting


def main() -> None:
    """Parses the command line, exports, says how well the file agrees with the policy."""
    with starting():
        from mjx_grasp.learning.export import ExportConfig, export_policy
        from mjx_grasp.records.command_line import parsed

        config = parsed(ExportConfig, __doc__)

    done = export_policy(config)
    print(
        f"largest difference from JAX: {done.difference:.1e}, "
        f"{done.observations} random and extreme observations"
    )
    print(f"written: {config.out}")


if __name__ == "__main__":
    run_command(main)
