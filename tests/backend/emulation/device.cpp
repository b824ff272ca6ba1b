// What a torch built without CUDA needs before tensors may say that they lie on cuda:0: a guard for the device type, so that
// operators and autograd can switch to it, and hooks that say it is there. Neither does anything: stand_in.py runs the operators.
#include <new>

#include <ATen/detail/CUDAHooksInterface.h>
#include <c10/core/impl/DeviceGuardImplInterface.h>

namespace {

using c10::Device, c10::DeviceIndex, c10::DeviceType, c10::Stream;
const Device DEVICE(DeviceType::CUDA, 0);

struct Guard : c10::impl::NoOpDeviceGuardImpl<DeviceType::CUDA> {
    Device exchangeDevice(Device) const override { return DEVICE; }
    Device getDevice() const override { return DEVICE; }
    Stream getStream(Device) const noexcept override { return Stream(Stream::DEFAULT, DEVICE); }
    Stream getNewStream(Device, int) const override { return Stream(Stream::DEFAULT, DEVICE); }
    Stream exchangeStream(Stream) const noexcept override { return Stream(Stream::DEFAULT, DEVICE); }
    void record(void**, const Stream&, DeviceIndex, c10::EventFlag) const override {}
    void block(void*, const Stream&) const override {}
    bool queryEvent(void*) const override { return true; }
    void synchronizeEvent(void*) const override {}
};

struct Hooks : at::CUDAHooksInterface {
    bool isBuilt() const override { return true; }
    bool isAvailable() const override { return true; }
    bool hasCUDA() const override { return true; }
    bool hasPrimaryContext(DeviceIndex) const override { return true; }
    DeviceIndex deviceCount() const override { return 1; }
};

static_assert(sizeof(Hooks) == sizeof(at::CUDAHooksInterface));

}  // namespace

namespace c10::impl {
C10_REGISTER_GUARD_IMPL(CUDA, Guard)
}

// Torch made its hooks when it was imported; others take their place.
extern "C" void say_that_cuda_is_there(bool there) {
    auto* hooks = const_cast<at::CUDAHooksInterface*>(&at::detail::getCUDAHooks());
    if (there) new (hooks) Hooks;
    else new (hooks) at::CUDAHooksInterface;
}
