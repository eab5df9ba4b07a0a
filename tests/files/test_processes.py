"""Worker processes and what they leave behind."""

from __future__ import annotations

import subprocess
import sys
import textwrap

SCRIPT = """
    import sys, time
    from tqdm import tqdm
    from irlos_pipe.files.processes import in_processes

    def work(path):
        list(tqdm([1], disable=True))
        open(path, "w").close()
        time.sleep(60)

    if __name__ == "__main__":
        try:
            with in_processes(1, work, [(sys.argv[1],)]):
                while not __import__("os").path.exists(sys.argv[1]):
                    time.sleep(0.05)
                raise KeyboardInterrupt
        except KeyboardInterrupt:
            print("interrupted")
"""


def test_a_worker_with_a_progress_bar_that_is_killed_leaves_nothing_behind(tmp_path):
    """No semaphore of the system, of which Python would warn at its end."""
    script = tmp_path / "run.py"
    script.write_text(textwrap.dedent(SCRIPT))
    done = subprocess.run(
        [sys.executable, script, tmp_path / "begun"], capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "interrupted\n", "")
