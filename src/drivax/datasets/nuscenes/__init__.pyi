from .reader import NuScenes as NuScenes
