"""The subcommands of `toolchain`: their flags, and what they print."""
