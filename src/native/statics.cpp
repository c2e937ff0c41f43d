#include "bindings.h"

namespace clamber {

void bind_statics(nb::module_&) {}

}  // namespace clamber
