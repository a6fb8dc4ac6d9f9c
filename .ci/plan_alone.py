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
# Its formula is that of a task that ships, so that it needs no Spot.
exec(compile(code, "README.md", "exec"))
