"""The log as lines of JSON, each with the id of the request that it is about."""

import logging
from datetime import UTC, datetime
from logging.config import dictConfig

import orjson

from service.http.visits import request_id


class JsonFormatter(logging.Formatter):
    """One object a line: time, level, logger, message, request_id, and the record's facts."""

    def format(self, record: logging.LogRecord) -> str:
        """The line of a record, without its end."""
        line = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            "request_id": request_id.get(),
            **getattr(record, "facts", {}),
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return orjson.dumps({k: v for k, v in line.items() if v is not None}, default=str).decode()


def log_as_json() -> None:
    """Write what this process logs to stderr, as JSON; requests by our line, not uvicorn's."""
    dictConfig(
        {
            "version": 1,
            "disable_existing_loggers": False,
            "formatters": {"json": {"()": JsonFormatter}},
            "handlers": {"stderr": {"class": "logging.StreamHandler", "formatter": "json"}},
            "root": {"handlers": ["stderr"], "level": "INFO"},
            "loggers": {"uvicorn.access": {"level": "WARNING"}},
        }
    )
