"""What the commands `linkax simulate`, `compare` and `sweep` compute; `linkax_command` reads what they are asked."""

from linkax.cli.main import run as run
