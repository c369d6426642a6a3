"""What goes wrong with stored things, said in a sentence."""


class StoreError(ValueError):
    """A store, table or record that can't be used; the message names it and says what to do."""


class MissingError(StoreError):
    """Something that isn't there (yet): a store, an array, a run, a view nobody has written."""


class ConfigError(ValueError):
    """A configuration that can't be used; the message names the file and the field."""
