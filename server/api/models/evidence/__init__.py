"""Documents for an auditor: certificates, and models that a field is compared with."""
