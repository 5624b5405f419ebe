// Which of the views that a pass draws this is for, and so the layer of their targets. A pass of both eyes is told; see `multiview`.
const view_at: u32 = 0u;
