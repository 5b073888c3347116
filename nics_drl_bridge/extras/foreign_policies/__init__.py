"""Policies trained elsewhere: networks with a mapping, and LEAPP bundles both ways.

The package finds this module by the entry point `nics_drl_bridge.adapters: foreign`.
"""

from nics_drl_bridge.extras.foreign_policies.convert import adapt, import_policy
from nics_drl_bridge.extras.foreign_policies.leapp_export import export_bundle

__all__ = ["adapt", "export_bundle", "import_policy"]
