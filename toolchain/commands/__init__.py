"""The `toolchain` command and its subcommands."""
