"""The command line: `linkax list`, `linkax simulate SCENE`, `linkax compare SCENE`."""

from linkax.cli.main import main as main
