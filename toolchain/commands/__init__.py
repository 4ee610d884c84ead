"""The `toolchain` command and its subcommands, one file each."""
