"""The umbrella command `rosbayes`, with all other commands as its subcommands."""
