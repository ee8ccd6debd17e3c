"""The parts of `benchmark_group_step.py`: the epoch, its models and inputs, and the page."""
