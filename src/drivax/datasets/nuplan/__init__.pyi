from .reader import NuPlan as NuPlan
