"""Errors that are told to the person who can mend them; the command line turns them into exit codes."""

from __future__ import annotations


class InputError(Exception):
    """A file, argument, configuration or message that cannot be used: exit code 2.

    The text is one line for the user: what (file, option), the value found, what was expected, what to do.
    """


class GoalNotReachedError(Exception):
    """The mission or the data ended without its goal: exit code 3."""
