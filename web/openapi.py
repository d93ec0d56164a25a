"""Prints the OpenAPI document of the service, from which the TypeScript client is made."""

import sys

import orjson

from service.app import create_app
from service.client import URL

document = create_app().openapi() | {"servers": [{"url": URL}]}
sys.stdout.buffer.write(orjson.dumps(document, option=orjson.OPT_INDENT_2))
