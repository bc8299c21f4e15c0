from .generate import Generation as Generation
