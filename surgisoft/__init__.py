"""Multi-agent surgical scenarios for soft robots, with arm models judged by measurements."""

__version__ = "0.1.0"


def parallel_env(task: str, **arguments):
    """The named task as a PettingZoo ParallelEnv; see `surgisoft.tasks.parallel.parallel_env`."""
    from surgisoft.tasks import parallel

    return parallel.parallel_env(task, **arguments)
