"""Command `sigmasplat doctor`: check the installation."""

import subprocess
import sys

from sigmasplat.commands import options
from sigmasplat.config.find_preset import list_presets, presets_by_scene

OK, UNHEALTHY = 0, 1


def doctor() -> int:
    """Check the installation: versions, processor, kernels, self-test.

    exit code 1 if a check fails; example: sigmasplat doctor
    """
    from sigmasplat.plugins.checks.installation import Finding, check_installation, verdict

    findings: list[Finding] = []
    for finding in check_installation():
        findings.append(finding)
        mark = {True: "ok  ", False: "FAIL", None: "    "}[finding.ok]
        print(f"{mark} {finding.name:<16}{finding.value}", flush=True)
    healthy, sentence = verdict(findings)
    print(sentence)
    return OK if healthy else UNHEALTHY


# tyro's script suggests commands and options. In other places it suggests one empty word, which is removed here, so
# that bash completes file names.
BASH = """
_sigmasplat() {{
  _tyro_sigmasplat
  local typed=${{COMP_WORDS[COMP_CWORD]}}
  [[ -n ${{COMPREPLY[0]}} ]] || COMPREPLY=()
  [[ ${{COMP_WORDS[COMP_CWORD-1]}} != --preset ]] || COMPREPLY=($(compgen -W "{presets}" -- "$typed"))
}}
complete -o bashdefault -o default -F _sigmasplat sigmasplat
"""


def completion(shell: options.Shell) -> int:
    """Print a script for tab completion; load it with: source <(sigmasplat completion bash)

    example: sigmasplat completion bash > ~/.local/share/bash-completion/completions/sigmasplat
    """
    # tyro prints the script and exits, so it runs in a separate process.
    command = [sys.executable, "-m", "sigmasplat", "--tyro-print-completion", shell]
    print(subprocess.run(command, capture_output=True, text=True, check=True).stdout, end="")
    if shell == "bash":
        print(BASH.format(presets=" ".join([*list_presets(), *presets_by_scene()])), end="")
    return 0
