"""What the commands `linkax simulate` and `linkax compare` compute; `linkax_command` reads what they are asked."""

from linkax.cli.main import run as run
