"""The store of a tracker in SQLite or PostgreSQL: schema, statements, retention and export."""

from importlib.util import find_spec

from hygrokf.errors import HygrokfError

if find_spec("sqlalchemy") is None:
    raise HygrokfError("a tracker's store needs SQLAlchemy: pip install 'hygrokf[live]'")
