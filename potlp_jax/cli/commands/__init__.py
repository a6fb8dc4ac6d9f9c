"""Options and help texts of the commands, a file per group.

What a command does is in `potlp_jax.cli`, in the file of its name, and is imported when the command runs, so that help
is quick.
"""
