"""What files by others are told, and whether they bake: every .blend file below a folder through check and bake of the command line.

    python bench/real_files.py FOLDER [--seconds 100] [--out out/real_files]        (a Python with bpy)

Each is checked, and baked to lightmaps of 64 and to attributes with two samples. Printed are a line for each file, with the four exit codes
(t: stopped at the time limit), and in how many files each kind of message came, names and numbers left out. All that was said is in
OUT/words.json.
"""

from __future__ import annotations

import argparse
import json
import re
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
OURS = f"""
import importlib.util, sys
spec = importlib.util.spec_from_file_location("adjgi", {str(ROOT / "__init__.py")!r}, submodule_search_locations=[{str(ROOT)!r}])
sys.modules["adjgi"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(sys.modules["adjgi"])
from adjgi.adjoint_gi.bridge.cli.main import console
console()
"""
TARGETS = {"texture": ["--resolution", "64"], "attribute": []}


def run(words: list[str], seconds: float) -> tuple[str, str]:
    """Exit code, or t, and all that was printed."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    process = subprocess.Popen([sys.executable, "-c", OURS, *words], **pipes, text=True, errors="replace")
    try:
        text, _ = process.communicate(timeout=seconds)
        return str(process.returncode), text
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
    try:
        return "t", process.communicate(timeout=60)[0]
    except subprocess.TimeoutExpired:
        process.kill()
        return "killed", process.communicate()[0]


def kind(line: str) -> str:
    """A message without the names and numbers in it."""
    text = re.sub(r"^(warning|error|info): .*?: ", r"\1: ", line)
    return re.sub(r'"[^"]*"|[\d,.]*\d', "_", text)[:100]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, default=100.0, help="for each run")
    parser.add_argument("--out", type=Path, default=Path("out/real_files"))
    options = parser.parse_args()
    files = sorted(options.folder.rglob("*.blend"))
    if not files:
        parser.error(f"{options.folder} holds no .blend file: name a folder that does")
    words, kinds, traces = {}, Counter(), 0
    for path in files:
        codes, said = [], set()
        with tempfile.TemporaryDirectory() as folder:
            for target, more in TARGETS.items():
                common = [str(path), "--target", target, *more, "--set", "samples=2"]
                kept = ["--save-blend", str(Path(folder) / "baked.blend"), "--overwrite"] if target == "attribute" else []
                for command in (["check", *common], ["bake", *common, "--output", folder, *kept]):
                    code, text = run(command, options.seconds)
                    codes.append(code)
                    traces += "Traceback" in text
                    words[f"{path} {command[0]} {target}"] = text
                    said |= {kind(line) for line in text.splitlines() if line.startswith(("warning:", "error:", "info:"))}
        kinds.update(said)
        print(f"{path.relative_to(options.folder)}: {' '.join(codes)}", flush=True)
    print(f"\n{len(files)} files, {traces} tracebacks")
    for text, count in kinds.most_common():
        print(f"{count:4d}  {text}")
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "words.json").write_text(json.dumps(words, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
