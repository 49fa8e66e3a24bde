"""The commands of ``splatam``, one file each. Whatever takes time to import is imported when a command runs."""
