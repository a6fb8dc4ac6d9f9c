"""Checks what a wheel holds: every file of the package that git tracks, and nothing else."""

import subprocess
import sys
import zipfile

tracked = subprocess.run(["git", "ls-files", "potlp_jax"], capture_output=True, text=True, check=True).stdout.split()
with zipfile.ZipFile(sys.argv[1]) as wheel:
    packed = [name for name in wheel.namelist() if ".dist-info/" not in name]
missing, foreign = set(tracked) - set(packed), set(packed) - set(tracked)
if missing or foreign:
    sys.exit(f"{sys.argv[1]}: {sorted(missing)} are missing, {sorted(foreign)} do not belong in it")
kinds = sorted({name.rpartition(".")[2] for name in packed})
print(f"{sys.argv[1].rpartition('/')[2]}: {len(packed)} files of the package ({', '.join(kinds)}), nothing else")
