"""Quality: how well a model fits its drive, and how far it can be trusted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Quality:
    """Figures of merit, by degree of freedom where they are mappings.

    Attributes:
        samples: rows that the fit used.
        outliers: share of the rows that were left out as outliers.
        condition: condition number of the standardised kept features.
        rmse: of the rates on the training part, in the unit of the rate.
        r2: share of the variance of the rates that is explained there.
        held_out_rmse, held_out_r2: the same on data that the fit never saw; empty without.
        open_loop_horizon_s: length of the open-loop predictions on that data [s]; 0 without.
        open_loop_position_error_m: mean position error at their ends [m].
        open_loop_heading_error_rad: mean heading error [rad].
        open_loop_path_m: mean length of the measured path [m].
    """

    samples: int
    outliers: dict[str, float]
    condition: dict[str, float]
    rmse: dict[str, float]
    r2: dict[str, float]
    held_out_rmse: dict[str, float]
    held_out_r2: dict[str, float]
    open_loop_horizon_s: float = 0.0
    open_loop_position_error_m: float = 0.0
    open_loop_heading_error_rad: float = 0.0
    open_loop_path_m: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """Plain data for YAML."""
        return {k: dict(v) if isinstance(v, dict) else v for k, v in vars(self).items()}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Quality:
        """Reads what `to_dict` wrote. Raises KeyError, TypeError or ValueError otherwise."""
        values: dict[str, Any] = {
            name: {str(k): float(v) for k, v in value.items()}
            if isinstance(value, dict)
            else float(value)
            for name, value in data.items()
        }
        return cls(**{**values, "samples": int(values["samples"])})
