"""Patterns of the names that people write in bench and batch files, and the same in words."""

NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]*$"
OPTIONAL_NAME = r"^[A-Za-z0-9_.-]*$"
NAME_WITH_BLANKS = r"^[A-Za-z0-9][A-Za-z0-9 _-]*$"
IN_WORDS = {
    NAME: "must consist of letters without accents, digits, '_', '.' and '-', and begin with "
    "a letter or digit",
    OPTIONAL_NAME: "must consist of letters without accents, digits, '_', '.' and '-'",
    NAME_WITH_BLANKS: "must consist of letters without accents, digits, blanks, '_' and '-', and "
    "begin with a letter or digit",
}
"""What a name that does not match has to be, as the end of a sentence, by pattern."""
