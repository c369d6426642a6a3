"""The table of metrics, whose columns follow from the metrics that are measured."""

from __future__ import annotations

import pyarrow as pa

from cat3d_core.metrics import measures
from schemas.tables import column, metrics_schema


def metric_table() -> pa.Schema:
    """The schema of `metrics/*.parquet`: a column for every metric, and one for the network of those that need one."""
    columns: dict[str, pa.Field] = {}
    for metric in measures.METRICS:
        columns[metric.name] = column(metric.name, pa.float64(), metric.meaning, metric.unit)
        if metric.network is not None:
            name = metric.network.column
            columns.setdefault(name, column(name, pa.string(), metric.network.meaning))
    return metrics_schema(list(columns.values()))
