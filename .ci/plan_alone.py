"""Runs the README's plan from arrays where only planning is installed: no OpenCV, Matplotlib, typer or Spot."""

import importlib.util
import re
import sys
from pathlib import Path

NOT_HERE = ("cv2", "matplotlib", "networkx", "PIL", "spot", "typer")

found = [name for name in NOT_HERE if importlib.util.find_spec(name) is not None]
if found:
    sys.exit(f"{', '.join(found)} came with an installation for planning alone")
blocks = re.findall(r"```python\n(.*?)```", Path(sys.argv[1]).read_text("utf-8"), re.DOTALL)
(code,) = [block for block in blocks if "PlanningProblem" in block]
# Compiling a formula needs Spot; the same task ships as an automaton.
code, replaced = re.subn(r'Task\.from_formula\("!fire U exit"\)', 'Task.shipped("firefighting-4")', code)
if replaced != 1:
    sys.exit("the README's plan from arrays has another formula: name its shipped task here")
exec(compile(code, "README.md", "exec"))
