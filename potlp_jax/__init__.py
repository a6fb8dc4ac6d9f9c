from potlp_jax.task.task import Task as Task
