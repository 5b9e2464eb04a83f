"""What functions leave behind, and how it is let go of."""

from scalarjit import functions, kept_programs, parts, traced, transform


def clear_caches() -> None:
    """Let go of what is known of functions, and of programs. What is used again is traced and written again.

    What JAX calls after that is compiled again, of text that is packed meanwhile.
    """
    functions.FUNCTIONS.clear()
    traced.clear()
    parts.clear()
    transform.clear()
    kept_programs.forget()
    if transform.handlers is not None:
        transform.handlers.clear()
