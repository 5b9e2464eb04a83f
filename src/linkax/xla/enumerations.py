"""Numbers behind the items of Equinox's enumerations, for batches, which have one in each member."""

from equinox._enum import EnumerationItem


def code(item):
    """The number of an item, or the numbers of a batch."""
    return item._value


def item(numbers, enumeration):
    """The item of a number, or of each of a batch."""
    return EnumerationItem(numbers, enumeration)  # pyright: ignore[reportCallIssue]


def is_item(node, enumeration) -> bool:
    """Whether something is an item of an enumeration, or a batch of such."""
    return isinstance(node, EnumerationItem) and node._enumeration is enumeration
