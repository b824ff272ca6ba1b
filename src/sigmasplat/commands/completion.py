"""Print what makes a shell complete our commands and options: sigmasplat completion."""

import subprocess
import sys

from sigmasplat.commands import options
from sigmasplat.presets import list_presets

# tyro's script offers commands and options, and one empty word where it knows none: files are then what one wants.
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
    """Print the shell's completion script; load it with source <(sigmasplat completion bash).

    example: sigmasplat completion bash > ~/.local/share/bash-completion/completions/sigmasplat
    """
    # A process of its own: tyro prints the script of the whole command line, and exits.
    command = [sys.executable, "-m", "sigmasplat", "--tyro-print-completion", shell]
    print(subprocess.run(command, capture_output=True, text=True, check=True).stdout, end="")
    if shell == "bash":
        print(BASH.format(presets=" ".join(list_presets())), end="")
    return 0
